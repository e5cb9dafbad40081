"""Faults of the detector and of what it answers: rows 13 to 18."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from small_crossing import write_config

from bikeped.config.load import load_config
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.types import Detections
from campaign.registry import row
from campaign.rig import Rig
from campaign.seams import crowd


@row(
    14,
    "the detector raises, then runs out of memory, for good",
    "FAULT, then a fresh process",
    "FAULT <= 1 s; ready <= 30 s",
    repeat=2,
)
def detector_fails(rig: Rig) -> None:
    for number in rig.repetitions:
        rig.control()
        supervisor = rig.supervise(seam="detector")
        rig.ready(supervisor.began_s, name=None)
        first = supervisor.process
        began_s = rig.fault(lambda: rig.control(("raise", "memory")[number % 2]))  # noqa: B023
        again_s = supervisor.next_start(began_s)
        rig.control()
        rig.not_reassuring(began_s + 1, again_s)
        rig.ready(began_s + 1)
        rig.expect(supervisor.process is not first, "no fresh process")
        supervisor.close()


@row(
    15, "NaN, infinite, negative, huge boxes and scores", "rejected", "cases >= 100000; crashes = 0"
)
def odd_boxes(rig: Rig) -> None:
    judge = _judge(rig.folder)
    rng = np.random.default_rng(15)
    odd = np.array([np.nan, np.inf, -np.inf, -1e9, 1e9, 1e38, -0.0, 0.0, 1e-30], np.float32)
    cases = crashes = frame = 0
    while cases < 100_000:
        n, frame = int(rng.integers(1, 120)), frame + 1
        box = rng.uniform(-200, 400, (n, 4)).astype(np.float32)
        swap = rng.random((n, 4)) < 0.4
        box[swap] = rng.choice(odd, int(swap.sum()))
        score = np.where(rng.random(n) < 0.3, rng.choice(odd, n), rng.random(n))
        kind = rng.integers(0, 3, n).astype(np.int8)
        cases += n
        try:
            with np.errstate(all="ignore"):
                judge.update(Detections(kind, score.astype(np.float32), box), 96, 64, frame / 30, 0)
        except Exception as error:  # noqa: BLE001 - that is what is counted
            crashes += 1
            rig.expect(False, f"{type(error).__name__}: {error}")
    rig.measure("cases", cases)
    rig.measure("crashes", crashes)


def _judge(folder: Path) -> TrackAndDecide:
    return TrackAndDecide(load_config(write_config(folder / "judge.yaml", "x", "bundled"), ()))


@row(
    16, "2,000 detections in a frame", "the work is capped", "p99 of the decision <= 5 ms", repeat=1
)
def crowded(rig: Rig) -> None:
    """The device's own figure: /healthz of the service, stages track and decide."""
    service = rig.start(None, "monitor.picture=false", seam="detector")
    service.settle()
    rig.control("crowd 2000")
    time.sleep(15)
    latency = service.health()[1]["latency_ms"]
    names = [name for name in ("track", "decide", "tracking", "decision") if name in latency]
    rig.measure("p99 of the decision", sum(latency[name]["p99"] for name in names))
    stages = ", ".join(f"{name} {latency[name]}" for name in names)
    rig.saw(f"{stages}; {len(crowd(2000, 96, 64))} boxes offered")


@row(17, "the detector answers nothing, while road users move", "withheld", "FAULT <= 60 s")
def detector_blind(rig: Rig) -> None:
    rig.start(seam="detector").settle()
    rig.fault(lambda: rig.control("empty"), wait_s=70)


@row(
    18,
    "inference stalls for 0.7 s, again and again",
    "no stale output",
    "FAULT <= 1 s; backlog <= 1 frames",
    repeat=20,
)
def inference_stalls(rig: Rig) -> None:
    service = rig.start(seam="detector")
    service.settle()
    for _ in rig.repetitions:
        began_s = rig.fault(lambda: rig.control("stall 0.9"))
        time.sleep(2)
        rig.not_reassuring(began_s + 1)
        rig.control()
        time.sleep(1.2)
        # Frames that waited would be judged late now: the age of what is captured says so.
        age_ms = service.health()[1]["camera"]["capture_age_ms"] or 0.0
        rig.measure("backlog", age_ms // 200)
        rig.ready(time.monotonic(), name=None)
