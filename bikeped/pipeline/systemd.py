"""Readiness and watchdog messages for systemd: sd_notify(3), a datagram on $NOTIFY_SOCKET."""

from __future__ import annotations

import logging
import os
import socket

log = logging.getLogger(__name__)


class Notifier:
    """Talks to the service manager; without one, every call does nothing."""

    def __init__(self, address: str | None = None) -> None:
        name = address if address is not None else os.environ.get("NOTIFY_SOCKET", "")
        # An abstract socket is written with an @ and addressed with a NUL (sd_notify(3)).
        self._address = "\0" + name[1:] if name.startswith("@") else name
        self._socket: socket.socket | None = None
        if self._address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    def ready(self, status: str) -> None:
        self._send(f"READY=1\nSTATUS={status}")

    def status(self, status: str) -> None:
        self._send(f"STATUS={status}")

    def alive(self) -> None:
        """Feeds the watchdog."""
        self._send("WATCHDOG=1")

    def starting(self, more_s: float, status: str) -> None:
        """Asks for `more_s` more seconds to start, as building an engine takes minutes."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(more_s * 1e6)}\nWATCHDOG=1\nSTATUS={status}")

    def stopping(self) -> None:
        self._send("STOPPING=1")

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, message: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError as error:  # never a reason to stop the service
            log.debug("systemd: %s", error)
