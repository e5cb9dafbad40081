"""Log lines of what may happen thirty times a second for months."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable


class RateLimitedLogger:
    """Says at most one line a subject every `every_s` seconds, and how many it kept back."""

    def __init__(
        self,
        log: logging.Logger,
        every_s: float = 10.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._log, self._every_s, self._clock = log, every_s, clock
        self._said: dict[str, tuple[float, int]] = {}

    def warn(self, subject: str, text: str) -> None:
        """A line of what was expected to happen now and then."""
        kept = self._due(subject)
        if kept is not None:
            self._log.warning("%s%s", text, kept)

    def failure(self, subject: str, error: BaseException) -> None:
        """A line of what nobody expected, with where it came from."""
        kept = self._due(subject)
        if kept is not None:
            self._log.error("%s: %s%s", subject, error, kept, exc_info=error)

    def _due(self, subject: str) -> str | None:
        now_s = self._clock()
        said_s, kept = self._said.get(subject, (None, 0))
        if said_s is not None and now_s - said_s < self._every_s:
            self._said[subject] = (said_s, kept + 1)
            return None
        self._said[subject] = (now_s, 0)
        return f" (and {kept} more since the last such line)" if kept else ""
