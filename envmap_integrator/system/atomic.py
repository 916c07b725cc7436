"""Files that appear under their name only when they're complete, whatever happens to the writer."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows, where nothing removes what killed writers leave.
    fcntl = None

#: How the names of temporary files begin.
PREFIX = ".envmap_integrator-"


class StorageError(ValueError):
    """A file that can't be written or read or isn't what it should be; the message is one line."""


def check_writable(path: Path) -> None:
    """Raise ``StorageError`` if no file can be written at ``path``, as far as that can be told."""
    folder = path.parent
    if not folder.is_dir():
        raise StorageError(f"{path}: there is no folder {folder}; make it first")
    if path.is_dir():
        raise StorageError(f"{path}: is a folder; choose another name")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise StorageError(
            f"{path}: the folder {folder} isn't writable; change its permissions or choose another"
        )


@contextmanager
def replacing(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """Yield a temporary file in the same folder; on success it takes the place of ``path``.

    A process that is killed and a power failure leave the old file or the new one; so does an
    error, after which no temporary file is left. Of several writers, the last to finish wins. Where
    ``path`` is a link, the file it leads to is replaced.

    Raises ``StorageError`` if the file can't be written, also for any ``OSError`` of the block.
    """
    path = Path(path)
    target = Path(os.path.realpath(path))
    try:
        check_writable(target)
        _remove_abandoned(target.parent)
        temporary, file = _create(target)
        try:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if fcntl is None:  # Windows replaces no open file; elsewhere, closing would unlock it.
                file.close()
            os.replace(temporary, target)
        finally:
            with suppress(OSError):  # Closing tries again to write what found no room.
                file.close()
            temporary.unlink(missing_ok=True)
        _sync_folder(target.parent)
    except OSError as error:
        raise StorageError(
            f"{path}: can't be written: {error.strerror or error}; make room there or choose "
            "another folder"
        ) from error


def _create(target: Path) -> tuple[Path, BinaryIO]:
    """A new file beside ``target``, locked for as long as it's open."""
    while True:
        temporary = target.with_name(f"{PREFIX}{secrets.token_hex(8)}{target.suffix}")
        file = open(temporary, "xb+")
        if fcntl is not None:
            with suppress(OSError):  # Where there are no locks, nothing is taken for abandoned.
                fcntl.flock(file, fcntl.LOCK_EX)
        if os.fstat(file.fileno()).st_nlink:
            return temporary, file
        file.close()  # Taken for abandoned before it was locked.


def _remove_abandoned(folder: Path) -> None:
    """Remove temporary files whose writers are gone, which their locks tell."""
    if fcntl is None:
        return
    for temporary in folder.glob(f"{PREFIX}*"):
        with suppress(OSError), open(temporary, "rb+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            temporary.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Make a new name in a folder outlast a power failure, where the system can do that."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
