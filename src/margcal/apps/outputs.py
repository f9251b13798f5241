"""Where results go: refused before the work is done where they could not be written after it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from margcal.core.errors import InputError, UsageError


def check_outputs(outputs: Sequence[str | None], inputs: Sequence[str], overwrite: bool) -> None:
    """Refuse outputs that exist (without `overwrite`), are an input or each other, or have no folder to be in."""
    given = [o for o in outputs if o is not None]
    real = [os.path.realpath(o) for o in given]
    if len(set(real)) < len(real):
        raise UsageError(f"two results would be written to {given[-1]}; give each a name of its own")
    for path, place in zip(given, real):
        if not path.strip():
            raise UsageError("the name of a result is empty; give a file")
        if any(place == os.path.realpath(i) for i in inputs):
            raise UsageError(f"{path} is read and would be overwritten; give the result another name")
        if not overwrite and Path(path).exists() and not _empty_folder(Path(path)):
            raise InputError(f"{path}: exists; give --overwrite to replace it")
        if not Path(place).parent.is_dir():
            raise InputError(f"{path}: the folder {Path(place).parent} does not exist; make it first")


def _empty_folder(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())
