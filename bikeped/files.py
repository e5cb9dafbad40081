"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from bikeped.errors import BikepedError


class WholeFile:
    """A temporary file beside `path`: `commit` renames it to `path`, `discard` removes it.

    `partial` is its path and ends like `path`, for writers that choose a format by the suffix. As
    a context manager it commits after success and discards after an exception. Raises OSError.
    """

    def __init__(self, path: Path, mode: int = 0o644) -> None:
        handle, name = tempfile.mkstemp(f".partial{path.suffix}", f".{path.stem}.", path.parent)
        os.close(handle)
        self.path, self.partial, self._mode = path, Path(name), mode

    def commit(self) -> None:
        """Gives the file its name and mode; removes it where that fails."""
        try:
            self.partial.chmod(self._mode)
            self.partial.replace(self.path)
        except BaseException:
            self.discard()
            raise

    def discard(self) -> None:
        """Removes the temporary file; again is harmless."""
        self.partial.unlink(missing_ok=True)

    def __enter__(self) -> Path:
        return self.partial

    def __exit__(self, kind: object, *rest: object) -> None:
        if kind is None:
            self.commit()
        else:
            self.discard()


@contextlib.contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder beside `folder`, renamed to it after success, else removed.

    An empty folder of that name is replaced. Raises OSError.
    """
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        yield partial
        partial.chmod(0o755)
        partial.replace(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def read_regular(path: Path, most_bytes: int = 1_000_000) -> bytes:
    """The bytes of a regular file of at most `most_bytes`.

    Never waits: a pipe or a device, which may deliver nothing or have no end, is refused. Raises
    OSError, whose `strerror` says what is wrong.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "it is not a regular file")
    with path.open("rb") as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {most_bytes / 1e6:g} MB")
    return data


def write_whole(path: Path, content: str | bytes) -> None:
    """Writes text (as UTF-8) or bytes under a temporary name and renames it.

    A pipe or a device is written to as it is: a rename would replace it. Raises BikepedError.
    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    with _named(path, "written", "choose a folder that exists and that you may write"):
        if path.exists() and not path.is_file() and not path.is_dir():
            path.write_bytes(data)
            return
        with WholeFile(path) as partial:
            partial.write_bytes(data)


def write_like(path: Path, content: bytes, like: Path) -> None:
    """As `write_whole`, flushed to the disk, with the mode and owner of the file `like`.

    For files such as config.yaml that have an owner and must survive a loss of power.
    """
    with _named(path, "written", "do it as a user who may write there"):
        status = like.stat()
        with WholeFile(path, status.st_mode & 0o7777) as partial:
            write_synced(partial, content)
            with contextlib.suppress(PermissionError):  # only root may change the owner
                os.chown(partial, status.st_uid, status.st_gid)


def write_synced(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Writes bytes and waits until they are on the disk. Raises OSError."""
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    path.chmod(mode)


def sync_folder(folder: Path) -> None:
    """Waits until the names in a folder are on the disk. Raises OSError."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(folder: Path, option: str = "--out") -> None:
    """Makes an output folder and its parents; BikepedError when it cannot."""
    with _named(folder, "made", f"choose another {option}"):
        folder.mkdir(parents=True, exist_ok=True)


@contextlib.contextmanager
def _named(path: Path, done: str, remedy: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BikepedError(f"{path}: cannot be {done} ({error.strerror}); {remedy}") from error
