"""The errors margcal raises on purpose: each says what, where and how to mend, and knows its exit status."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from margcal.core.types import Issue


class MargcalError(Exception):
    """Base of every deliberate error; `exit_status` is what the command line returns for it."""

    exit_status = 1


class InputError(MargcalError):
    """The input cannot be read or understood (exit status 1)."""

    exit_status = 1


class UsageError(MargcalError):
    """The call itself is wrong, such as an option that does not exist or two that exclude each other (2)."""

    exit_status = 2


class DataError(MargcalError):
    """The data were read but cannot carry what was asked (exit status 3).

    `issues` holds the reasons, each with what to record next.
    """

    exit_status = 3

    def __init__(self, message: str, issues: Sequence[Issue] = ()) -> None:
        super().__init__(message)
        self.issues = tuple(issues)
