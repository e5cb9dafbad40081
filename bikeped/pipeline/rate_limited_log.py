"""Log lines of events that may come thirty times a second for months."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable


class RateLimitedLogger:
    """Logs at most one line a subject every `every_s` seconds, and how many it suppressed."""

    def __init__(
        self,
        log: logging.Logger,
        every_s: float = 10.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._log, self._every_s, self._clock = log, every_s, clock
        self._logged: dict[str, tuple[float, int]] = {}

    def warn(self, subject: str, text: str) -> None:
        """A warning of an expected event."""
        suppressed = self._due(subject)
        if suppressed is not None:
            self._log.warning("%s%s", text, suppressed)

    def failure(self, subject: str, error: BaseException) -> None:
        """An unexpected error, with its traceback."""
        suppressed = self._due(subject)
        if suppressed is not None:
            self._log.error("%s: %s%s", subject, error, suppressed, exc_info=error)

    def _due(self, subject: str) -> str | None:
        now_s = self._clock()
        logged_s, suppressed = self._logged.get(subject, (None, 0))
        if logged_s is not None and now_s - logged_s < self._every_s:
            self._logged[subject] = (logged_s, suppressed + 1)
            return None
        self._logged[subject] = (now_s, 0)
        return f" (and {suppressed} more since the last such line)" if suppressed else ""
