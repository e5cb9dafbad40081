"""One scenario frame by frame, as the pages draw it, with the numbers of the deployed rule.

Times are frames / 30 s; positions are in the plan (x east, y north, metres), rounded to mm; missing
values are null. Arrays run over frames; `start` arrays hold the index of a frame's first entry.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from bikeped.config.schema import DecisionConfig
from bikeped.decision.decider import explain, pair_metrics, select_pair, shown_sentence
from bikeped.decision.episodes import onsets
from bikeped.decision.rules import PairChecks, is_remembered
from bikeped.geometry.camera import GroundCamera
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.lab.simulation.metrics import finite_or_none
from bikeped.lab.simulation.simulate import FPS, verdicts
from bikeped.lab.simulation.truth import ATTENTIVE_PRT_S, PEDESTRIAN_PRT_S, GroundTruth
from bikeped.lab.testbench.runner import BenchSuite
from bikeped.types import BoolArray, FloatArray, IntArray, Kind, State

#: Codes of the truth's tiers in `truth.tier`.
TIERS = ("none", "actionable", "imminent")
_COVER_BEARINGS = 90
_COVER_REACH_M = 40.0


def playback(
    suite: BenchSuite, index: int, decisions: Mapping[str, DecisionConfig]
) -> dict[str, Any]:
    """Scenario `index` as JSON data: road users, tracks, ground truth, and each decision."""
    scenario, truth = suite.scenarios[index], suite.truths[index]
    return {
        "scenario": {
            key: getattr(scenario, key)
            for key in ("name", "hazard", "vehicle", "story", "duration_s")
        },
        "frames": len(truth.time_s),
        "fps": FPS,
        "agents": _agents(suite, index),
        "tracks": _tracks(suite, index),
        "truth": _truth(truth),
        "closest_s": finite_or_none(_closest(truth)),
        "prt_s": {"distracted": PEDESTRIAN_PRT_S, "attentive": ATTENTIVE_PRT_S},
        "delay_frames": suite.delay.frames,
        "order": suite.delay.order,
        "sides": [_side(suite, index, name, d) for name, d in decisions.items()],
        "expected": scenario.expected,
        "tests": list(TESTS),
    }


def coverage(camera: GroundCamera, pose: CameraPose) -> dict[str, Any]:
    """The ground in a camera's view: its nearest and farthest visible points by bearing, as two
    outlines in the plan (null where no ground is visible), and the camera's pose."""
    bearing = np.linspace(-np.pi, np.pi, _COVER_BEARINGS, endpoint=False)
    reach = np.concatenate([np.arange(0.1, 5, 0.1), np.arange(5, _COVER_REACH_M + 0.1, 0.25)])
    ground = np.stack([np.cos(bearing)[:, None] * reach, np.sin(bearing)[:, None] * reach], -1)
    _, seen = camera.project(ground.reshape(-1, 2))
    seen = np.asarray(seen).reshape(len(bearing), len(reach))
    some = np.atleast_1d(seen.any(axis=1))
    near, far = seen.argmax(axis=1), len(reach) - 1 - seen[:, ::-1].argmax(axis=1)
    step = np.arange(len(bearing))

    def outline(at: Any) -> list[float | None]:
        world = pose.ground_to_world(ground[step, at])
        return _flat(np.where(some[:, None], world, np.nan))

    return {
        "x": pose.x_m,
        "y": pose.y_m,
        "heading_deg": pose.heading_deg - camera.heading_deg,
        "near": outline(near),
        "far": outline(far),
        "reach_m": _COVER_REACH_M,
    }


def _agents(suite: BenchSuite, index: int) -> list[dict[str, Any]]:
    """Each agent's true path, and its detections in the frames that the tracker gets."""
    scene, seen = suite.shown_detections[index], suite.perception_results[index]
    late = suite.delay.frames
    found = []
    for a, agent in enumerate(suite.scenarios[index].agents):
        xy, heading, _ = agent.sample(suite.truths[index].time_s)
        put = np.where(scene.detected[:, a, None], scene.xy_m[:, a], np.nan)
        # 1 in frames in which the agent is in view and the detector missed it
        missed = (seen.present[:, a] & ~scene.detected[:, a]).astype(float)
        found.append(
            {
                "id": agent.id,
                "kind": agent.kind,
                "role": Kind(int(seen.kind[a])).label,
                "size_m": list(agent.size_m),
                "true": _flat(xy),
                "heading": _rounded(heading),
                "detected": _flat(_delayed(suite.pose.ground_to_world(put), late)),
                "missed": np.nan_to_num(_delayed(missed, late)).astype(int).tolist(),
                "error_m": _rounded(_delayed(np.hypot(*(put - seen.true_m[:, a]).T), late)),
                "path": agent.path.tolist(),
            }
        )
    return found


def _delayed(values: FloatArray, frames: int) -> FloatArray:
    out = np.full_like(values, np.nan)
    if frames < len(values):
        out[frames:] = values[: len(values) - frames]
    return out


def _tracks(suite: BenchSuite, index: int) -> dict[str, Any]:
    """The tracks that the rules get, frame by frame."""
    run = suite.rule_input
    frames = run.frame_slice(index)
    first, last = np.searchsorted(run.rows.frame, [frames.start, frames.stop])
    rows = slice(int(first), int(last))
    start = np.searchsorted(run.rows.frame[rows], np.arange(frames.start, frames.stop + 1))
    return {
        "start": start.tolist(),
        "id": run.rows.id[rows].tolist(),
        "kind": [Kind(k).label for k in run.rows.kind[rows].tolist()],
        "xy": _flat(suite.pose.ground_to_world(run.rows.xy_m[rows])),
    }


def _truth(truth: GroundTruth) -> dict[str, Any]:
    numbers = ("distance_m", "nearest_m", "d_min_m", "ttc_s", "budget_s", "severity")
    return {
        "tier": danger_tier(truth).tolist(),
        **{key: _rounded(getattr(truth, key)) for key in numbers},
        "cyclist": truth.cyclist.tolist(),
        "pedestrian": truth.pedestrian.tolist(),
    }


def danger_tier(truth: GroundTruth) -> IntArray:
    """The tier [f] of every frame, as an index of `TIERS`."""
    return np.asarray(truth.danger.astype(int) + truth.imminent)


def _closest(truth: GroundTruth) -> float:
    if not np.isfinite(truth.nearest_m).any():
        return float("nan")
    return float(truth.time_s[int(np.argmin(truth.nearest_m))])


def _side(suite: BenchSuite, index: int, name: str, decision: DecisionConfig) -> dict[str, Any]:
    """One decision on the scenario: states, sentences and numbers of every frame."""
    run, settings = suite.rule_input, suite.tracker.rule(decision)
    frames = run.frame_slice(index)
    shown = suite.outcome(decision)
    codes = shown.states
    found = verdicts(run, settings)
    own, raw = codes[frames], shown.raw[frames]
    truth = suite.truths[index]
    pair_frame = run.rows.frame[run.pairs.pedestrian_row]
    start = np.searchsorted(pair_frame, np.arange(frames.start, frames.stop + 1))
    walking = run.rows.frame[run.rows.counts & (run.rows.kind == int(Kind.PEDESTRIAN))]
    pedestrians = np.bincount(walking, minlength=frames.stop)[frames]
    since = run.time_s[frames] - run.cyclist_last_s[frames]
    sentences, chosen = [], []
    for i in range(len(own)):
        part = slice(int(start[i]), int(start[i + 1]))
        state = State(int(raw[i]))
        at = select_pair(state, found.fires[part], found.distance_m[part])
        pair = None
        if at is not None:
            pair = pair_metrics(part.start + at, run.rows, run.pairs, found, settings)
        sentence = explain(state, pair, int(pedestrians[i]), float(since[i]), settings)
        sentences.append(shown_sentence(state, State(int(own[i])), sentence, settings))
        chosen.append(-1 if at is None else part.start + at - int(start[0]))
    alert = own == int(State.ALERT)
    return {
        "name": name,
        "decision": msgspec.to_builtins(decision),
        "memory_s": settings.memory_s,
        "lookback_s": settings.lookback_s,
        "state": own.tolist(),
        "raw_state": raw.tolist(),
        "sentence": sentences,
        "chosen": chosen,
        "pedestrians": pedestrians.tolist(),
        "since_cyclist_s": _rounded(since),
        "remembered": is_remembered(
            run.time_s[frames], run.cyclist_last_s[frames], settings.memory_s
        ).tolist(),
        "pairs": _pairs(suite, found, slice(int(start[0]), int(start[-1])), start),
        "onsets": [
            {
                "frame": int(i),
                "t": float(truth.time_s[i]),
                "budget_s": finite_or_none(float(truth.budget_s[i])),
                "danger": bool(truth.danger[i]),
            }
            for i in np.flatnonzero(onsets(alert))
        ],
        "metrics": suite.measure(decision).scenario_dict(index),
        "counts": _counts(truth, alert),
    }


def _counts(truth: GroundTruth, alert: BoolArray) -> dict[str, int]:
    """Frames by truth and alert, of this scenario."""
    masks = {
        "danger": truth.danger,
        "actionable": truth.actionable,
        "actionable_alert": truth.actionable & alert,
        "calm": ~truth.danger,
        "calm_alert": ~truth.danger & alert,
    }
    return {"frames": len(alert), **{key: int(mask.sum()) for key, mask in masks.items()}}


def _pairs(suite: BenchSuite, found: PairChecks, part: slice, start: Any) -> dict[str, Any]:
    """Numbers and checks of every pair of every frame; `passes` has one bit for each check."""
    run = suite.rule_input
    cyclist = run.pairs.cyclist_row[run.pairs.cyclist[part]]
    pedestrian = run.pairs.pedestrian_row[part]
    bits = np.zeros(len(cyclist), np.int64)
    for bit, field in enumerate(TESTS.values()):
        bits |= getattr(found, field)[part].astype(np.int64) << bit
    reach = np.maximum(np.hypot(*run.rows.xy_m[cyclist].T), np.hypot(*run.rows.xy_m[pedestrian].T))
    numbers = ("distance_m", "lookback_s", "displacement_m", "speed_mps", "d_max_m")
    return {
        "start": (start - start[0]).tolist(),
        "cyclist": run.rows.id[cyclist].tolist(),
        "pedestrian": run.rows.id[pedestrian].tolist(),
        "passes": bits.tolist(),
        **{key: _rounded(getattr(found, key)[part]) for key in numbers},
        "then_m": _rounded(found.distance_then_m[part]),
        "reach_m": _rounded(reach),
    }


#: The tests of a pair by the bits of `passes`: name for the page, field of `PairChecks`.
TESTS = {
    "in_range": "in_range",
    "far_enough": "above_d_min",
    "near_enough": "below_d_max",
    "judged": "evaluated",
    "closing": "closing",
    "enough": "displacement_ok",
    "fires": "fires",
}


def _rounded(values: FloatArray) -> list[float | None]:
    """Numbers with three decimals; null where not finite."""
    rounded = np.round(values, 3).tolist()
    return [v if v - v == 0 else None for v in rounded]


def _flat(xy: FloatArray) -> list[float | None]:
    """[x0, y0, x1, y1, ...]."""
    return _rounded(np.asarray(xy).reshape(-1))
