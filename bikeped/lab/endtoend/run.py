"""Scenarios rendered as JPEG frames and run through the deployed loop, one process each."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import simplejpeg

from bikeped.capture.base import FrameSource
from bikeped.config.load import LoadedConfig
from bikeped.feedback.signal_logic import SignalLogic
from bikeped.lab.process_pool import ProgressCallback, no_progress, run_jobs
from bikeped.lab.rendering import Conditions, DrawnObject, ScenePainter, scene_camera
from bikeped.lab.scenarios.scenario import Scenario
from bikeped.lab.simulation.simulate import FPS
from bikeped.pipeline.application import load_detector_pool
from bikeped.pipeline.detection_scheduler import DetectionStage, FrameDetector
from bikeped.pipeline.feed import RecordedFeed
from bikeped.pipeline.loop import FrameResult, Loop
from bikeped.pipeline.signal_dispatcher import SignalDispatcher
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.types import Detections, Frame


@dataclass(frozen=True)
class EndToEndRun:
    """One scenario end to end: what was drawn, detected and decided in each frame."""

    scenario: Scenario
    objects: tuple[tuple[DrawnObject, ...], ...]
    detections: tuple[Detections, ...]
    state: npt.NDArray[np.int8]  #: [f], as shown
    raw_state: npt.NDArray[np.int8]  #: [f], of the rule
    width: int
    height: int
    detector: str
    model_hash: str | None
    cyclist_box_includes_rider: bool  #: as the detector has it


class _Recorder:
    """An output of the loop that keeps detections and states."""

    def __init__(self) -> None:
        self.detections: list[Detections] = []
        self.state: list[int] = []
        self.raw_state: list[int] = []

    async def on_frame_result(self, result: FrameResult) -> None:
        self.detections.append(result.detections)
        decision = result.tracking.decision
        self.state.append(int(decision.state))
        self.raw_state.append(int(decision.state if decision.raw is None else decision.raw))


def run_scenario(
    loaded: LoadedConfig,
    scenario: Scenario,
    conditions: Conditions,
    size: tuple[int, int],
    detector: FrameDetector | None = None,
) -> EndToEndRun:
    """Draws `scenario` and runs it through the loop; `detector` replaces the configured model."""
    detector = detector if detector is not None else load_detector_pool(loaded)
    painter = ScenePainter(scenario, scene_camera(loaded, size), conditions)
    source = DrawnSource(painter, scenario.name, scenario.frame_times(FPS).tolist(), FPS)
    recorder = _Recorder()
    track_and_decide = TrackAndDecide(
        loaded, cyclist_box_includes_rider=detector.cyclist_box_includes_rider
    )

    async def run_loop() -> None:
        loop = Loop(
            feed=RecordedFeed(source),
            detection=DetectionStage(detector),
            track_and_decide=track_and_decide,
            dispatcher=SignalDispatcher(SignalLogic.from_config(loaded.config.feedback)),
            outputs=[recorder],
        )
        await loop.run()

    asyncio.run(run_loop())
    return EndToEndRun(
        scenario=scenario,
        objects=tuple(source.objects),
        detections=tuple(recorder.detections),
        state=np.asarray(recorder.state, np.int8),
        raw_state=np.asarray(recorder.raw_state, np.int8),
        width=size[0],
        height=size[1],
        detector=detector.name,
        model_hash=detector.model_hash,
        cyclist_box_includes_rider=detector.cyclist_box_includes_rider,
    )


def run_all(
    loaded: LoadedConfig,
    scenarios: Sequence[Scenario],
    conditions: Conditions,
    size: tuple[int, int],
    processes: int = 1,
    progress: ProgressCallback = no_progress,
) -> list[EndToEndRun]:
    """A run of every scenario, in their order; the longest start first."""
    order = sorted(range(len(scenarios)), key=lambda i: -scenarios[i].duration_s)
    jobs = [(loaded, scenarios[i], conditions, size) for i in order]
    runs = run_jobs(run_scenario, jobs, processes, progress)
    return [run for _, run in sorted(zip(order, runs, strict=True), key=lambda pair: pair[0])]


#: Roughly that of the pole's camera: its compression affects small figures.
JPEG_QUALITY = 90


class DrawnSource(FrameSource):
    """Renders a frame at each read; `objects` holds the drawn objects of each, in order."""

    def __init__(self, painter: ScenePainter, name: str, time_s: Sequence[float], fps: float):
        self._painter = painter
        self._time_s = tuple(time_s)
        self.name = name
        self.width, self.height = painter.camera.size
        self.fps = fps
        self.live = False
        self.objects: list[tuple[DrawnObject, ...]] = []

    def read(self) -> Frame | None:
        number = len(self.objects)
        if number >= len(self._time_s):
            return None
        t = self._time_s[number]
        rgb, objects = self._painter.draw(t)
        self.objects.append(tuple(objects))
        jpeg: bytes = simplejpeg.encode_jpeg(
            rgb, quality=JPEG_QUALITY, colorspace="RGB", colorsubsampling="420"
        )
        return Frame(number, t, self.width, self.height, jpeg=jpeg)

    def close(self) -> None:
        """Nothing to release."""
