"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

from bikeped.errors import BikepedError


def write_whole(path: Path, content: str | bytes) -> None:
    """Writes text (as UTF-8) or bytes under a temporary name and renames it.

    A pipe or a device is written to as it is; a file of its name would take its place.
    BikepedError, naming the file and the mend, when it cannot.
    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            path.write_bytes(data)
            return
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
            Path(name).chmod(0o644)
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise BikepedError(
            f"{path}: cannot be written ({error.strerror}); choose a folder that exists and that "
            "you may write"
        ) from error


def write_like(path: Path, content: bytes, like: Path) -> None:
    """As `write_whole`, onto the disk, with the mode and owner of the file `like`.

    For files that belong to somebody, such as config.yaml, and must survive a loss of power.
    """
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            was = like.stat()
            Path(name).chmod(was.st_mode & 0o7777)
            with contextlib.suppress(PermissionError):  # only root gives files away
                os.chown(name, was.st_uid, was.st_gid)
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise BikepedError(
            f"{path}: cannot be written ({error.strerror}); do it as a user who may write there"
        ) from error


def make_folder(folder: Path, option: str = "--out") -> None:
    """Makes an output folder and its parents; BikepedError when that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BikepedError(
            f"{folder}: cannot be made ({error.strerror}); choose another {option}"
        ) from error
