"""`replay`: a recording through the loop of `run`, and what it writes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import signal as signals
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bikeped.capture import open_source
from bikeped.capture.recordings import PacedSource
from bikeped.config.load import LoadedConfig
from bikeped.decision.episodes import EpisodeTracker
from bikeped.errors import BikepedError, GeometryError
from bikeped.feedback.light import LightDriver, SimulatedLight
from bikeped.overlay.video import VideoWriter, compose
from bikeped.pipeline.application import Application, Pages, load_detector_pool, new_event_header
from bikeped.pipeline.detection_scheduler import FrameDetector
from bikeped.pipeline.feed import RecordedFeed
from bikeped.pipeline.loop import FrameResult, FrameResultListener, frame_overlay
from bikeped.pipeline.telemetry import event_line_for
from bikeped.pipeline.track_and_decide import GroundMapper, TrackAndDecide
from bikeped.telemetry.event_files import EventWriter
from bikeped.telemetry.latency import StageTimes
from bikeped.types import Kind, State

log = logging.getLogger(__name__)

#: The percentiles of a replay are those of all its frames, up to this many (nearly an hour).
LATENCY_FRAMES = 100_000
#: Fewer detections do not show whether the camera settings fit the recording.
MIN_DETECTIONS = 20
OVERLAY_SIZE = (1600, 720)


@dataclass
class ReplayResult:
    """Figures of one replay; `progress` is called with the number of frames so far."""

    config_hash: str
    detector: str
    warnings: list[str]
    progress: Callable[[int], None] = lambda frames: None
    frames: int = 0  #: that led to a decision
    states: Counter[str] = field(default_factory=Counter)
    tracks: dict[str, set[int]] = field(default_factory=dict)
    detections: int = 0
    not_on_ground: int = 0
    alerts: list[dict[str, Any]] = field(default_factory=list)
    duration_s: float = 0.0
    undecodable: int = 0
    wall_s: float = 0.0
    times: StageTimes = field(default_factory=StageTimes)
    interrupted: bool = False  #: stopped by a signal: all figures cover only what came before
    _episodes: EpisodeTracker = field(default_factory=EpisodeTracker)

    async def on_frame_result(self, result: FrameResult) -> None:
        tracking, decision = result.tracking, result.tracking.decision
        self.frames += 1
        self.duration_s = result.t_s
        self.detections += len(result.detections)
        self.not_on_ground += tracking.not_on_ground
        self.states[decision.state.name] += 1
        for key, kind in zip(tracking.tracks.id.tolist(), tracking.tracks.kind, strict=True):
            self.tracks.setdefault(Kind(kind).label, set()).add(key)
        change = self._episodes.update(decision.state is State.ALERT)
        if change == "begins":
            alert = {"t": round(result.t_s, 3), "frame": result.decoded.frame.number}
            self.alerts.append({**alert, "sentence": decision.sentence, "frames": 1})
        elif change == "lasts":
            self.alerts[-1]["frames"] += 1
        self.progress(self.frames)

    def as_dict(self) -> dict[str, Any]:
        """The summary, for `--json`."""
        return {
            "frames": self.frames,
            "interrupted": self.interrupted,
            "undecodable": self.undecodable,
            "duration_s": round(self.duration_s, 3),
            "states": dict(sorted(self.states.items())),
            "tracks": {kind: len(ids) for kind, ids in sorted(self.tracks.items())},
            "alerts": self.alerts,
            "detections": self.detections,
            "not_on_ground": self.not_on_ground,
            "warnings": self.warnings,
            "detector": self.detector,
            "config_hash": self.config_hash,
            "frames_per_second": round(self.frames / max(self.wall_s, 1e-9), 2),
            "latency_ms": {
                stage: {name: round(value, 3) for name, value in row.items()}
                for stage, row in self.times.percentiles().items()
            },
        }


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
        if self._drawing is not None:
            # A cancelled caller leaves the thread drawing: the next caller must wait for it, too.
            await asyncio.shield(self._drawing)


def replay(
    loaded: LoadedConfig,
    recording: str,
    *,
    detector: FrameDetector | None = None,
    own_camera: bool = False,
    events: Path | None = None,
    overlay: Path | None = None,
    realtime: bool = False,
    mqtt: bool = True,
    progress: Callable[[int], None] = lambda frames: None,
    pages: Pages | None = None,
    serving: Callable[[str], None] = lambda address: None,
) -> ReplayResult:
    """Runs a recording through the loop; raises BikepedError with one line and a remedy.

    `detector` replaces the configured model; it belongs to the recording. A recording of another
    size than the configured camera's is warned about unless `detector` is given or the configured
    camera made it (`own_camera`). `events` and `overlay` are files to write.
    `pages` are served while it runs; `serving` gets their address.
    """
    with contextlib.ExitStack() as files:
        source = files.enter_context(open_source(loaded.config.camera, recording))
        if source.live:
            raise BikepedError(f"{source.name}: is a camera, not a recording; use bikeped run")
        ground_mapper = GroundMapper(loaded)
        try:
            ground_mapper.framing_for(source.width, source.height)
        except GeometryError as error:
            raise GeometryError(f"{loaded.source}: {source.name}: {error}") from error
        size, camera = (source.width, source.height), loaded.config.camera
        warnings = []
        if not own_camera and detector is None and size != (camera.width, camera.height):
            warnings.append(
                f"{source.name}: frames are {source.width} x {source.height}, taken as scaled "
                f"copies of {loaded.source}'s {camera.width} x {camera.height}; were they made by "
                "another camera, set camera.width, camera.height and its lens"
            )
        model = detector or load_detector_pool(loaded, recorded=not realtime)
        track_and_decide = TrackAndDecide(loaded, model.cyclist_box_includes_rider, ground_mapper)
        result = ReplayResult(loaded.hash, model.name, warnings, progress)
        outputs: list[FrameResultListener] = [result]
        if events is not None:
            event_file = EventFile(events, new_event_header(loaded, model))
            files.callback(event_file.partial_path.unlink, missing_ok=True)  # no rest after errors
            files.enter_context(event_file)
            outputs.append(event_file)
        video = None
        if overlay is not None:
            fps = source.fps if source.fps > 0 else 30.0
            writer = files.enter_context(VideoWriter(overlay, fps, OVERLAY_SIZE))
            video = OverlayVideo(writer, track_and_decide)
            outputs.append(video)
        # A replay must not switch the lamps of a crossing. It may run slower than real time, so its
        # light has a watchdog of an hour.
        blink_hz = loaded.config.feedback.fault_blink_hz
        light = LightDriver(SimulatedLight, fault_blink_hz=blink_hz, watchdog_s=3600.0)
        light.start()
        files.callback(light.close)

        async def run_loop() -> None:
            async with contextlib.AsyncExitStack() as stack:
                if video is not None:
                    stack.push_async_callback(video.wait)
                application = Application(
                    loaded,
                    model,
                    track_and_decide,
                    stack,
                    feed=RecordedFeed(PacedSource(source) if realtime else source),
                    source=source.name,
                    light=light,
                    mqtt=mqtt and loaded.config.mqtt.enabled,
                    pages=pages,
                    outputs=outputs,
                    view_width=OVERLAY_SIZE[0] if video is not None else 0,
                    latency_frames=LATENCY_FRAMES,
                )
                await _run_until_signal(application, result, serving, stack)

        asyncio.run(run_loop())
        if result.frames == 0:
            raise BikepedError(
                f"{source.name}: no frame could be read ({result.undecodable} did not decode); "
                "check the recording"
            )
    if result.detections >= MIN_DETECTIONS and 2 * result.not_on_ground > result.detections:
        text = (
            f"{result.not_on_ground} of {result.detections} detections end above the horizon or "
            f"outside the image circle: {loaded.source} is for another camera or mounting; set the "
            "camera section (projection, fov_deg, radius_px, pitch_deg) to the one that made this"
        )
        log.warning("%s", text)
        result.warnings.append(text)
    return result


async def _run_until_signal(
    application: Application,
    result: ReplayResult,
    serving: Callable[[str], None],
    stack: contextlib.AsyncExitStack,
) -> None:
    """Serves the pages and runs the loop until the recording or a signal ends it."""
    server = await application.serve_pages()
    if server is not None and server.error is not None:
        raise BikepedError(server.error)
    if server is not None:
        serving(str(server.address))
    # Logged only now, when nothing can be refused any more: an error is one line on its own.
    for text in result.warnings:
        log.warning("%s", text)
    loop, running = application.loop, asyncio.get_running_loop()
    for number in (signals.SIGTERM, signals.SIGINT):
        # They end the replay after the current frame, with whole files.
        with contextlib.suppress(RuntimeError, ValueError):  # in another thread: no signals
            running.add_signal_handler(number, loop.stopping.set)
            stack.callback(running.remove_signal_handler, number)
    result.times, began = application.telemetry.times, time.perf_counter()
    await application.run()
    result.wall_s = time.perf_counter() - began
    result.undecodable, result.interrupted = loop.counts.undecodable, loop.stopping.is_set()
