"""Where one worker's picture waits for the next one."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

from bikeped.pipeline.detection_stage import Picture


class LatestFrameSlot:
    """Room for one picture between two workers; None, put last, is the end."""

    def __init__(self) -> None:
        self._item: Picture | None = None
        self._filled, self._empty = asyncio.Event(), asyncio.Event()
        self._empty.set()
        self.ended = False

    async def room(self) -> None:
        """Returns when the slot is empty."""
        await self._empty.wait()

    def put(self, item: Picture | None) -> None:
        self._item = item
        self.ended = item is None
        self._empty.clear()
        self._filled.set()

    async def filled(self) -> None:
        """Returns when there is a picture, or the end."""
        await self._filled.wait()

    def take(self) -> Picture | None:
        """The picture, if there is one now."""
        item, self._item = self._item, None
        if item is not None:
            self._filled.clear()
            self._empty.set()
        return item


async def first_of(future: asyncio.Future[Any], other: Coroutine[Any, Any, None]) -> None:
    """Returns when one of the two is done; cancels `other`, never `future`."""
    task = asyncio.ensure_future(other)
    try:
        await asyncio.wait({future, task}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        task.cancel()
