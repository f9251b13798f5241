"""Results appear whole or not at all: written beside their place, then renamed into it.

Whatever goes wrong (an exception, Ctrl-C, a full disk) leaves the old file as it was and no half one behind.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from margcal.core.checking import printable
from margcal.core.errors import InputError


@contextmanager
def atomic_path(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary path in the folder of `path`, with its suffix; it becomes `path` when the block ends well.

    Parameters
    ----------
    path : path-like
        A symbolic link is followed: the file that it names is replaced, the link stays.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    InputError
        The file exists, is a folder or a device, its folder is missing or not writable, or the disk is full.
    """
    target = _checked_target(Path(path), overwrite)
    if target.is_dir():
        raise InputError(f"{printable(path)}: is a folder; give the name of a file")
    temporary = target.with_name(f".{secrets.token_hex(6)}.{target.name[-100:]}")
    try:
        with _mended(path):
            yield temporary
            _sync(temporary)
            if target.exists():
                if not overwrite:  # appeared while we were writing
                    raise InputError(f"{printable(path)}: exists; give --overwrite to replace it")
                shutil.copymode(target, temporary)
            os.replace(temporary, target)
            _sync(target.parent)
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def atomic_folder(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside `path`; it becomes `path` when the block ends well.

    An existing folder that is empty is taken. With `overwrite` the new files replace those of the same name,
    one after the other; whatever else lies in the folder stays.

    Raises
    ------
    InputError
        As `atomic_path`.
    """
    path = Path(path)
    occupied = path.is_dir() and any(path.iterdir())
    target = _checked_target(path, overwrite or (path.is_dir() and not occupied))
    if target.exists() and not target.is_dir():
        raise InputError(f"{printable(path)}: is a file; give the name of a folder")
    temporary = target.with_name(f".{secrets.token_hex(6)}.{target.name[-100:]}")
    try:
        with _mended(path):
            temporary.mkdir()
            yield temporary
            for file in temporary.rglob("*"):
                if file.is_file():
                    _sync(file)
            if target.exists():
                _move_files(temporary, target)
            else:
                os.replace(temporary, target)
            _sync(target.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _move_files(source: Path, target: Path) -> None:
    for file in sorted(source.rglob("*")):
        place = target / file.relative_to(source)
        if file.is_dir():
            place.mkdir(exist_ok=True)
        else:
            os.replace(file, place)


def _checked_target(path: Path, overwrite: bool) -> Path:
    """Where the result goes, links followed; refused before any work is done where it could not go there."""
    target = Path(os.path.realpath(path)) if path.is_symlink() else path.absolute()
    shown = printable(path)
    if not target.parent.is_dir():
        raise InputError(f"{shown}: the folder {printable(target.parent)} does not exist; make it first")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise InputError(f"{shown}: the folder {printable(target.parent)} is not writable")
    if target.exists() and not target.is_file() and not target.is_dir():
        raise InputError(f"{shown}: is not a regular file; give the name of a file")
    if (target.is_file() or (target.is_dir() and any(target.iterdir()))) and not overwrite:
        what = "the folder exists and is not empty" if target.is_dir() else "exists"
        raise InputError(f"{shown}: {what}; give --overwrite to replace it")
    return target


@contextmanager
def _mended(path: str | os.PathLike[str]) -> Iterator[None]:
    """A full disk, or one that may not be written, is the user's to mend; other OS errors are not ours to hide."""
    try:
        yield
    except OSError as error:
        shown = printable(os.fspath(path))
        if error.errno in (errno.ENOSPC, errno.EDQUOT) or "No space left" in str(error):
            raise InputError(f"{shown}: the disk is full; free some space or choose another place") from error
        if error.errno == errno.EFBIG:
            raise InputError(
                f"{shown}: cannot be written: larger than a file may be on this disk; choose another place, or a "
                "smaller format (.parquet)"
            ) from error
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG, errno.EIO):
            raise InputError(f"{shown}: cannot be written ({error.strerror})") from error
        raise


def _sync(path: Path) -> None:
    """Flush a file or folder to the disk; file systems that cannot sync a folder are left alone."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except PermissionError:
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(handle)
