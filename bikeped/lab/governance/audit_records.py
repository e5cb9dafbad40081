"""Audit records of a simulated run: true and observed positions, tracks, decision of each frame.

JSON Lines: for each scenario one `header`, then one `frame` after the other (paper, section 4:
post-hoc review of any individual alert or missed detection). Positions are in the camera ground
frame (x forward, y right, metres), times in seconds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bikeped.config.load import LoadedConfig, config_hash
from bikeped.config.provenance import decision_hash
from bikeped.config.schema import DecisionConfig
from bikeped.decision.rules import RuleSettings
from bikeped.errors import BikepedError
from bikeped.files import WholeFile
from bikeped.lab.simulation.simulate import RuleInput, verdicts
from bikeped.lab.simulation.suite import Suite, result_provenance
from bikeped.types import FloatArray, State

#: Decimals of a record: 0.1 mm, 0.1 ms.
_DIGITS = 4
#: What a record holds of the pair checks.
_CHECKED = ("distance_m", "distance_then_m", "lookback_s", "displacement_m", "d_max_m")


def write_audit(
    path: Path, suite: Suite, decision: DecisionConfig, loaded: LoadedConfig, seed: int = 0
) -> None:
    """Writes the audit of a run without loss; the file appears whole or not at all.

    `seed` is recorded only: nothing here is random.
    """
    try:
        with WholeFile(path) as partial, partial.open("w", encoding="utf-8") as file:
            for record in audit_records(suite, decision, loaded, seed):
                file.write(json.dumps(record, allow_nan=False, separators=(",", ":")) + "\n")
    except OSError as error:
        raise BikepedError(
            f"{path}: the audit cannot be written ({error.strerror}); give --audit a file in a "
            "folder that exists and has room"
        ) from error


def audit_records(
    suite: Suite, decision: DecisionConfig, loaded: LoadedConfig, seed: int = 0
) -> Iterator[dict[str, Any]]:
    """The records of all scenarios in order, header first."""
    run = suite.rule_input
    found = suite.outcome(decision)
    fired = _first_fired(run, suite.tracker.rule(decision))
    rows_of_frame = np.searchsorted(run.rows.frame, np.arange(len(run.time_s) + 1))
    config = msgspec.structs.replace(loaded.config, decision=decision)
    common = {
        **result_provenance(suite, loaded, seed),
        "config_hash": config_hash(config, loaded.calibration_hash),
        "decision_hash": decision_hash(decision),
        "decision": msgspec.to_builtins(decision),
    }
    for index, scenario in enumerate(suite.scenarios):
        frames = run.frame_slice(index)
        yield {
            "type": "header",
            "scenario": scenario.name,
            "hazard": scenario.hazard,
            "expected": scenario.expected,
            "vehicle": scenario.vehicle,
            "frames": frames.stop - frames.start,
            "agents": [{"id": a.id, "kind": a.kind} for a in scenario.agents],
            **common,
        }
        truth, seen = suite.truths[index], suite.perception_results[index]
        error = seen.error_m
        for i, frame in enumerate(range(frames.start, frames.stop)):
            known = truth.cyclist[i] >= 0
            yield {
                "type": "frame",
                "scenario": scenario.name,
                "frame": i,
                "t": _real(truth.time_s[i]),
                "agents": [
                    {
                        "id": agent.id,
                        "true": _point(seen.true_m[i, a]),
                        "observed": _point(seen.observed_m[i, a]),
                        "error_m": _real(error[i, a]),
                    }
                    for a, agent in enumerate(scenario.agents)
                    if seen.present[i, a]
                ],
                "tracks": [
                    {
                        "id": int(run.rows.id[row]),
                        "kind": int(run.rows.kind[row]),
                        "at": _point(run.rows.xy_m[row]),
                    }
                    for row in range(rows_of_frame[frame], rows_of_frame[frame + 1])
                ],
                "state": State(int(found.states[frame])).name,
                "raw_state": State(int(found.raw[frame])).name,
                "alert_tracks": fired.get(frame),
                "pair": [int(truth.cyclist[i]), int(truth.pedestrian[i])] if known else None,
                "distance_m": _real(truth.distance_m[i]),
                "danger": bool(truth.danger[i]),
                "actionable": bool(truth.actionable[i]),
                "severity": _real(truth.severity[i]),
                "ttc_s": _real(truth.ttc_s[i]),
                "budget_s": _real(truth.budget_s[i]),
            }


def _first_fired(run: RuleInput, settings: RuleSettings) -> dict[int, dict[str, Any]]:
    """By frame: the first pair in track order that fired, as on the pole, and its distances."""
    found = verdicts(run, settings)
    pairs, rows = run.pairs, run.rows
    out: dict[int, dict[str, Any]] = {}
    for index in np.nonzero(found.fires)[0]:
        cyclist, pedestrian = pairs.cyclist_row[pairs.cyclist[index]], pairs.pedestrian_row[index]
        out.setdefault(
            int(rows.frame[pedestrian]),
            {
                "cyclist": int(rows.id[cyclist]),
                "pedestrian": int(rows.id[pedestrian]),
                **{key: _real(getattr(found, key)[index]) for key in _CHECKED},
            },
        )
    return out


def _real(value: float) -> float | None:
    return round(float(value), _DIGITS) if math.isfinite(value) else None


def _point(xy: FloatArray) -> list[float | None]:
    return [_real(xy[0]), _real(xy[1])]
