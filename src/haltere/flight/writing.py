"""Writing files that are whole under their final names, or not there. It knows no format and no content."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from haltere.errors import HaltereError

__all__ = ["whole_files"]

MARK = ".writing-"
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
OS_ERROR = re.compile(r" \(os error (\d+)\)")


@contextlib.contextmanager
def whole_files(folder: Path, last: str, stale: Iterable[str] = ()) -> Iterator[Path]:
    """A hidden folder to write files into, which come under their final names in ``folder`` when the block ends well.

    Parameters
    ----------
    folder
        Where the files go; made if it is not there. Files of the same names are replaced, others are left alone.
    last
        The file that comes last and is taken away first: where it is, all files are of one and the same writing.
    stale
        Files of an earlier writing that are taken away.

    Raises
    ------
    HaltereError
        The folder cannot be written, or there is no room. Nothing has changed in it then.

    Notes
    -----
    Files are flushed to the disk before they are renamed (fsync). A file system may order the renaming before the content, and may report
    a full disk only then: without it a power cut could leave an empty file under a final name.

    What a killed process leaves is hidden, and taken away by the next writing to the same place. It is told from the work of a
    process that still runs by a lock, which ends with its process.
    """
    folder = Path(folder)
    beside = f".{folder.name}{MARK}"
    with _told(folder):
        if folder.exists() and not folder.is_dir():
            raise HaltereError("a folder to write to", "a file", str(folder), "name another folder (--out)")
        folder.parent.mkdir(parents=True, exist_ok=True)
        _sweep(folder.parent, beside)
        _sweep(folder, MARK)
        # Inside a folder that is there, as it may be on a file system of its own; beside one that is not, to be renamed as a whole.
        work = folder / MARK if folder.is_dir() else folder.parent / beside
        work = work.with_name(f"{work.name}{secrets.token_hex(6)}")
    held = -1
    try:
        with _told(folder):
            work.mkdir()  # an interruption may come right after it
            held = os.open(work, os.O_RDONLY)
            fcntl.flock(held, fcntl.LOCK_EX)
            yield work
            for file in work.iterdir():
                _flush(file)
            _put(work, folder, last, stale)
    finally:
        try:
            if held >= 0:
                os.close(held)
            shutil.rmtree(work, ignore_errors=True)
        except BaseException:  # interrupted while it was cleared away
            shutil.rmtree(work, ignore_errors=True)
            raise


def _put(work: Path, folder: Path, last: str, stale: Iterable[str]) -> None:
    """Move finished files to their final names."""
    if not folder.exists():
        try:
            os.replace(work, folder)
        except OSError:
            if not folder.is_dir():  # else another process made it meanwhile
                raise
        else:
            _flush(folder.parent)
            return
    (folder / last).unlink(missing_ok=True)
    for name in stale:
        (folder / name).unlink(missing_ok=True)
    _flush(folder)
    for file in sorted(work.iterdir(), key=lambda p: p.name == last):
        os.replace(file, folder / file.name)
    _flush(folder)


def _flush(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that has no such thing
            raise
    finally:
        os.close(handle)


def _sweep(folder: Path, mark: str) -> None:
    """Take away what killed processes left."""
    if not folder.is_dir():
        return
    for left in folder.iterdir():
        if not left.name.startswith(mark) or left.is_symlink() or not left.is_dir():
            continue
        with contextlib.suppress(OSError):  # gone meanwhile, another user's, or still being written
            handle = os.open(left, os.O_RDONLY)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(left, ignore_errors=True)
            finally:
                os.close(handle)


@contextlib.contextmanager
def _told(folder: Path) -> Iterator[None]:
    """What the system says of a write that failed, as the one error that users meet."""
    from polars.exceptions import PolarsError

    try:
        yield
    except (OSError, PolarsError) as error:
        # polars tells of the system's error in words alone: "... IO error: No space left on device (os error 28)"
        words = str(error).splitlines()[0].rpartition("IO error: ")[2]
        number = OS_ERROR.search(words)
        code = getattr(error, "errno", None) or (int(number[1]) if number else 0)
        found = getattr(error, "strerror", None) or OS_ERROR.sub("", words)
    else:
        return
    remedy = "check the path and its permissions, or name another folder (--out)"
    if code in NO_ROOM:
        remedy = "make room there, or name a folder on another disk"
    raise HaltereError("a folder that can be written", found, str(folder), remedy)
