"""The one decoded frame that may wait for the detector."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

from bikeped.pipeline.detection_stage import DecodedFrame


class LatestFrameSlot:
    """Holds at most one decoded frame; None, put last, is the end."""

    def __init__(self) -> None:
        self._item: DecodedFrame | None = None
        self._full, self._empty = asyncio.Event(), asyncio.Event()
        self._empty.set()
        self.ended = False

    async def wait_empty(self) -> None:
        """Returns when the slot is empty."""
        await self._empty.wait()

    async def wait_full(self) -> None:
        """Returns when there is a frame, or the end."""
        await self._full.wait()

    def put(self, item: DecodedFrame | None) -> None:
        """Fills the slot."""
        self._item = item
        self.ended = item is None
        self._empty.clear()
        self._full.set()

    def get_nowait(self) -> DecodedFrame | None:
        """The frame, if there is one now."""
        item, self._item = self._item, None
        if item is not None:
            self._full.clear()
            self._empty.set()
        return item


async def first_of(future: asyncio.Future[Any], other: Coroutine[Any, Any, None]) -> None:
    """Returns when one of the two is done; cancels `other`, never `future`."""
    task = asyncio.ensure_future(other)
    try:
        await asyncio.wait({future, task}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        task.cancel()
