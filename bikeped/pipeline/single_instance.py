"""One service for one configuration, light and camera: a second is refused, by the first's pid.

A claim is an abstract Unix socket that is bound while the process lives. The kernel frees it,
whatever ends the process, and no file stays behind; connecting to it tells who holds it. It covers
this host (strictly: its network namespace).
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hashlib
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import msgspec

from bikeped.config.load import LoadedConfig
from bikeped.errors import ConfigError

_PENDING = 128  #: connections of people who ask for the holder, until it accepts them


def claims_of(loaded: LoadedConfig) -> dict[str, str]:
    """What a service of this configuration holds alone: name for people, and unique key."""
    camera, feedback = loaded.config.camera, loaded.config.feedback
    held = {}
    if Path(loaded.source).is_file():
        held[loaded.source] = str(Path(loaded.source).resolve())
    driver = getattr(loaded.config if feedback.light == "lamp" else feedback, feedback.light, None)
    if driver is not None:  # lamps that are wired
        settings = msgspec.json.encode(driver, order="deterministic").decode()
        held[f"the {feedback.light} light"] = f"{feedback.light} {settings}"
    device = f"/dev/video{camera.source}" if camera.source.isdecimal() else camera.source
    if device.startswith("/dev/"):
        held[device] = str(Path(device).resolve())
    return held


def holder(loaded: LoadedConfig) -> tuple[str, int] | None:
    """What of this configuration a running service holds, and its pid; None: nothing is held."""
    for name, key in claims_of(loaded).items():
        if (pid := _holder_of(key)) is not None:
            return name, pid
    return None


def _holder_of(key: str) -> int | None:
    """The pid of the process that has claimed it; 0: it does not answer; None: it is free."""
    with socket.socket(socket.AF_UNIX) as asking:
        asking.setblocking(False)
        try:
            asking.connect(_address(key))
        except BlockingIOError:  # it is stopped, and many have asked
            return 0
        except OSError:
            return None
        size = struct.calcsize("3i")
        credentials = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
        return int(struct.unpack("3i", credentials)[0])


@contextlib.contextmanager
def claimed(loaded: LoadedConfig) -> Iterator[None]:
    """Claims all that this configuration holds; call it in the running event loop.

    Raises ConfigError, naming what is held and the pid of the service that holds it.
    """
    loop = asyncio.get_running_loop()
    with contextlib.ExitStack() as stack:
        for name, key in claims_of(loaded).items():
            claim = stack.enter_context(socket.socket(socket.AF_UNIX))
            claim.setblocking(False)
            try:
                claim.bind(_address(key))
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
                pid = _holder_of(key) or "unknown"
                raise ConfigError(
                    f"{name} is in use by another bikeped (pid {pid}); stop that one "
                    "first, e.g. with systemctl stop bikeped"
                ) from error
            claim.listen(_PENDING)
            loop.add_reader(claim.fileno(), _forget_asker, claim)
            stack.callback(loop.remove_reader, claim.fileno())
        yield


def _forget_asker(claim: socket.socket) -> None:
    with contextlib.suppress(OSError):  # it may have gone
        claim.accept()[0].close()


def _address(key: str) -> bytes:
    # Another user's service is refused, too: lines and cameras are the host's.
    return b"\0bikeped-" + hashlib.sha256(os.fsencode(key)).hexdigest()[:32].encode()
