"""Scenarios drawn and sent through the deployed loop, each in a process of its own."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bikeped.config import LoadedConfig
from bikeped.feedback import SignalLogic
from bikeped.lab.endtoend.drawn_source import DrawnSource
from bikeped.lab.process_pool import worker_pool
from bikeped.lab.rendering import Conditions, DrawnObject, ScenePainter, scene_camera
from bikeped.lab.scenarios.scenario import Scenario
from bikeped.lab.simulation.simulate import FPS
from bikeped.pipeline.detection_stage import Eye, Vision
from bikeped.pipeline.factory import load_eye
from bikeped.pipeline.feed import RecordedFeed
from bikeped.pipeline.loop import Loop, Outcome
from bikeped.pipeline.signal_dispatcher import Announcer
from bikeped.pipeline.track_and_decide import Judge
from bikeped.types import Detections


@dataclass(frozen=True)
class EndToEndRun:
    """One scenario from pixels: what was drawn, found and decided in each frame."""

    scenario: Scenario
    objects: tuple[tuple[DrawnObject, ...], ...]
    detections: tuple[Detections, ...]
    state: npt.NDArray[np.int8]  #: [f]
    width: int
    height: int
    detector: str
    model_hash: str | None
    riders_whole: bool  #: as the detector has it


class _Kept:
    """An output of the loop that keeps what was found and decided."""

    def __init__(self) -> None:
        self.detections: list[Detections] = []
        self.state: list[int] = []

    async def frame(self, outcome: Outcome) -> None:
        self.detections.append(outcome.detections)
        self.state.append(int(outcome.judgement.decision.state))


def run_scenario(
    loaded: LoadedConfig,
    scenario: Scenario,
    conditions: Conditions,
    size: tuple[int, int],
    eye: Eye | None = None,
) -> EndToEndRun:
    """Draws `scenario` and runs it through the loop; `eye` in place of the configured model."""
    looking = eye if eye is not None else load_eye(loaded)
    painter = ScenePainter(scenario, scene_camera(loaded, size), conditions)
    source = DrawnSource(painter, scenario.name, scenario.frame_times(FPS).tolist(), FPS)
    kept = _Kept()
    judge = Judge(loaded, riders_whole=looking.riders_whole)

    async def through() -> None:
        loop = Loop(
            feed=RecordedFeed(source),
            vision=Vision(looking),
            judge=judge,
            announcer=Announcer(SignalLogic.from_config(loaded.config.feedback)),
            outputs=[kept],
        )
        await loop.run()

    asyncio.run(through())
    return EndToEndRun(
        scenario=scenario,
        objects=tuple(source.objects),
        detections=tuple(kept.detections),
        state=np.asarray(kept.state, np.int8),
        width=size[0],
        height=size[1],
        detector=looking.name,
        model_hash=looking.model_hash,
        riders_whole=looking.riders_whole,
    )


def run_all(
    loaded: LoadedConfig,
    scenarios: Sequence[Scenario],
    conditions: Conditions,
    size: tuple[int, int],
    processes: int = 1,
    progress: Callable[[int], None] = lambda done: None,
) -> list[EndToEndRun]:
    """Every scenario, longest first over `processes`, in the given order."""
    if processes == 1:
        runs = []
        for scenario in scenarios:
            runs.append(run_scenario(loaded, scenario, conditions, size))
            progress(len(runs))
        return runs
    found: dict[int, EndToEndRun] = {}
    with worker_pool(processes) as pool:
        order = sorted(range(len(scenarios)), key=lambda i: -scenarios[i].duration_s)
        jobs = {i: pool.submit(run_scenario, loaded, scenarios[i], conditions, size) for i in order}
        for index in order:
            found[index] = jobs[index].result()
            progress(len(found))
    return [found[i] for i in range(len(scenarios))]
