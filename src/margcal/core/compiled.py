"""The compiled kernels, or None: the one door to the extension `margcal.core._ext` (C++, in ``src/ext``).

Every caller has its plain NumPy path beside the call: the readable reference, the oracle of the tests, and what
runs where the extension is missing. Both give the same numbers to about 1e-15 of their size::

    kernels = compiled.extension()
    if kernels is not None:
        kernels.apply(y, H, B, out)

The environment variable ``MARGCAL_NO_EXT=1`` turns the extension off.
"""

from __future__ import annotations

import os

_decided = False
_kernels = None
_state = ""


def extension():
    """The extension module, or None if it is turned off, was not built, or was built for another Python.

    (The return type is left to the type checker, which knows the module from its stub ``_ext.pyi``.)
    """
    if not _decided:
        _decide()
    return _kernels


def state() -> str:
    """Whether the kernels are compiled, in words: ``yes (avx2)`` or ``no (reason)``."""
    kernels = extension()
    return f"yes ({kernels.lanes()})" if kernels is not None else f"no ({_state})"


def _decide() -> None:
    global _decided, _kernels, _state
    _decided = True
    if os.environ.get("MARGCAL_NO_EXT", "") not in ("", "0"):
        _state = "MARGCAL_NO_EXT is set"
        return
    try:
        import margcal.core._ext as module
    except ModuleNotFoundError:
        _state = "not built for this Python; installing margcal where there is a C++ compiler builds them"
    except ImportError as error:  # built on another machine
        _state = f"cannot be loaded: {error}"
    else:
        _kernels = module
