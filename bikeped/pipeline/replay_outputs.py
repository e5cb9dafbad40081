"""What a replay writes: the summary, the event file, the overlay video."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from bikeped.decision.episodes import EpisodeTracker
from bikeped.overlay import VideoWriter, compose
from bikeped.pipeline.frame_result import FrameResult, frame_overlay
from bikeped.pipeline.telemetry import event_line_for
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.telemetry.events import EventWriter
from bikeped.types import Kind, State

OVERLAY_SIZE = (1600, 720)


@dataclass
class ReplaySummary:
    """Totals of a replay; `progress` is called with the number of frames so far."""

    progress: Callable[[int], None] = lambda frames: None
    frames: int = 0
    states: dict[str, int] = field(default_factory=dict)
    tracks: dict[str, set[int]] = field(default_factory=dict)
    detections: int = 0
    not_on_ground: int = 0
    alerts: list[dict[str, Any]] = field(default_factory=list)
    duration_s: float = 0.0
    warnings: list[str] = field(default_factory=list)
    _episodes: EpisodeTracker = field(default_factory=EpisodeTracker)

    async def on_frame_result(self, result: FrameResult) -> None:
        frame, tracking = result.decoded.frame, result.tracking
        self.frames += 1
        self.duration_s = result.t_s
        self.detections += len(result.detections)
        self.not_on_ground += tracking.not_on_ground
        decision = tracking.decision
        self.states[decision.state.name] = self.states.get(decision.state.name, 0) + 1
        for key, kind in zip(tracking.tracks.id.tolist(), tracking.tracks.kind, strict=True):
            self.tracks.setdefault(Kind(kind).label, set()).add(key)
        change = self._episodes.update(decision.state is State.ALERT)
        if change == "begins":
            alert = {"t": round(result.t_s, 3), "frame": frame.number}
            self.alerts.append({**alert, "sentence": decision.sentence, "frames": 1})
        elif change == "lasts":
            self.alerts[-1]["frames"] += 1
        self.progress(self.frames)


class EventFile(EventWriter):
    """The event file of a replay."""

    async def on_frame_result(self, result: FrameResult) -> None:
        self.write(event_line_for(result))


class OverlayVideo:
    """The overlay video of a replay: drawn in a thread while the next frame is detected."""

    def __init__(self, writer: VideoWriter, track_and_decide: TrackAndDecide) -> None:
        self._writer, self._track_and_decide = writer, track_and_decide
        self._fov_deg = math.degrees(2 * track_and_decide.ground_mapper.camera.lens.max_theta_rad)
        self._drawing: asyncio.Task[None] | None = None

    async def on_frame_result(self, result: FrameResult) -> None:
        await self.wait()
        data, to_frame = frame_overlay(result, self._track_and_decide)
        camera = self._track_and_decide.ground_mapper.camera

        def draw() -> None:
            self._writer.write(
                compose(
                    result.decoded.rgb,
                    data,
                    self._writer.size,
                    frame_width=result.decoded.frame.width,
                    ground_to_frame=to_frame,
                    fov_deg=self._fov_deg,
                    heading_deg=camera.heading_deg,
                )
            )

        self._drawing = asyncio.create_task(asyncio.to_thread(draw))

    async def wait(self) -> None:
        """Waits until the current frame is drawn; raises the error of drawing."""
        task = self._drawing
        if task is None:
            return
        try:
            # A cancelled caller leaves the thread drawing: the next caller must wait for it, too.
            await asyncio.shield(task)
        finally:
            if task.done():
                self._drawing = None
