"""How a light behaved over traffic: nuisance, misses, metrics (definitions, 14, 15). Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.decision.episodes import runs
from bikeped.decision.shown import shown_states
from bikeped.lab.simulation.metrics import GroundTruthFrames, measure
from bikeped.lab.simulation.simulate import FPS
from bikeped.lab.simulation.truth import PEDESTRIAN_PRT_S, GroundTruth
from bikeped.types import BoolArray, FloatArray, IntArray

#: A real conflict belongs to an alert from this long before it to this long after it.
BEFORE_S, AFTER_S = 0.2, 3.0
#: A conflict is missed without an alert in so long before it.
WARNED_WITHIN_S = 5.0
#: Only of a pair in view for so long before can a rule be judged.
FAIR_S = 2.2
SHORT_S, RED_AGAIN_S = 0.5, 2.0
#: Red with the nearest pair beyond this is red about people far apart.
FAR_PAIR_M = 10.0
_EPSILON_S = 1e-6
_METRICS = (
    *("sensitivity", "specificity", "specificity_shown", "specificity_strict"),
    *("contact_sensitivity", "contact_sensitivity_raw", "sev_fn", "mean_warning_budget_s"),
    "first_onset_lead_s",
    "held_frames",
)


@dataclass(frozen=True)
class Conflicts:
    """Real conflicts [c]: time, how long the pair had been in view, ids of cyclist and pedestrian
    [c, 2]."""

    time_s: FloatArray
    in_view_s: FloatArray
    ids: IntArray

    @property
    def fair(self) -> BoolArray:
        return np.asarray(self.in_view_s >= FAIR_S - _EPSILON_S)


@dataclass(frozen=True)
class LightRecord:
    """One scene's light by frame [f]: raw state codes, where ALERT is shown, and the truth.

    `both_in_view`: at least one cyclist and one pedestrian are in view.
    """

    truth: GroundTruth
    both_in_view: BoolArray
    conflicts: Conflicts
    raw: npt.NDArray[np.int8]
    shown: BoolArray

    @property
    def states(self) -> npt.NDArray[np.int8]:
        """State codes as the light shows them."""
        return shown_states(self.raw, self.shown)

    def episodes(self) -> Episodes:
        """The scene's alerts as shown."""
        found = runs(self.shown)
        found = found[self.shown[found[:, 0]]] if len(found) else found
        danger = np.concatenate([[0], np.cumsum(self.truth.danger)])
        begin_s, end_s = found[:, 0] / FPS, (found[:, 1] - 1) / FPS
        conflict_s = self.conflicts.time_s[:, None]
        near = (conflict_s >= begin_s - BEFORE_S - _EPSILON_S) & (
            conflict_s <= end_s + AFTER_S + _EPSILON_S
        )
        return Episodes(
            found, danger[found[:, 1]] > danger[found[:, 0]], np.asarray(near.any(axis=0))
        )

    def missed_and_late(self) -> tuple[BoolArray, BoolArray]:
        """Which conflicts [c] came without an alert in the 5 s before, and which with none earlier
        than a distracted pedestrian's reaction time."""
        red_s = self.truth.time_s[self.shown]

        def alerts(from_s: FloatArray, until_s: FloatArray) -> IntArray:
            first = red_s.searchsorted(from_s - _EPSILON_S)
            return np.asarray(red_s.searchsorted(until_s + _EPSILON_S) - first)

        at = self.conflicts.time_s
        missed = alerts(at - WARNED_WITHIN_S, at) == 0
        early = alerts(at - WARNED_WITHIN_S, at - PEDESTRIAN_PRT_S) > 0
        return missed, ~missed & ~early


@dataclass(frozen=True)
class Episodes:
    """Alerts [e] of a scene: first frame and the one after the last [e, 2], whether there was
    danger in it, and whether a real conflict belongs to it."""

    frames: IntArray
    danger: BoolArray
    conflict: BoolArray

    @property
    def justified(self) -> BoolArray:
        return self.danger | self.conflict


def light_figures(lights: Sequence[LightRecord]) -> dict[str, Any]:
    """All figures of one rule over these scenes, by their JSON names; null: nothing to count."""
    episodes = [light.episodes() for light in lights]
    count = sum(len(e.frames) for e in episodes)
    frames = sum(len(light.raw) for light in lights)
    hours = frames / FPS / 3600
    both_hours = hours_both_in_view(lights)
    red = np.concatenate([light.shown for light in lights])
    truth = GroundTruthFrames.join([light.truth for light in lights])
    nearest_m = truth.nearest_m[red]
    changes = [np.diff(light.states) != 0 for light in lights]
    both = [light.both_in_view for light in lights]
    both_changes = sum(int((c & b[1:]).sum()) for c, b in zip(changes, both, strict=True))
    onsets_both = sum(int(b[e.frames[:, 0]].sum()) for b, e in zip(both, episodes, strict=True))
    gaps = [(e.frames[1:, 0] - e.frames[:-1, 1]) / FPS <= RED_AGAIN_S for e in episodes]
    short = sum(int((np.diff(e.frames)[:, 0] / FPS < SHORT_S - _EPSILON_S).sum()) for e in episodes)
    return {
        "alerts_per_hour": _per(count, hours),
        "alerts_per_hour_both_in_view": _per(onsets_both, both_hours),
        "red_share": float(red.mean()),
        "alerts_with_danger": _per(sum(int(e.justified.sum()) for e in episodes), count),
        "alerts_with_real_conflict": _per(sum(int(e.conflict.sum()) for e in episodes), count),
        "episodes_under_500ms": _per(short, count),
        "changes_per_minute": _per(sum(int(c.sum()) for c in changes), hours * 60),
        "changes_per_minute_both_in_view": _per(both_changes, both_hours * 60),
        "red_off_red_per_hour": _per(sum(int(g.sum()) for g in gaps), hours),
        "red_without_danger": _per(int((~truth.danger[red]).sum()), int(red.sum())),
        "red_nearest_pair_far": _per(
            int(((nearest_m > FAR_PAIR_M) & np.isfinite(nearest_m)).sum()), int(red.sum())
        ),
        "red_without_pair": _per(int((~np.isfinite(nearest_m)).sum()), int(red.sum())),
        **_conflict_figures(lights),
        **_metric_figures(truth, lights),
    }


def hours_both_in_view(lights: Sequence[LightRecord]) -> float:
    """Hours in which at least one cyclist and one pedestrian are in view."""
    return sum(int(light.both_in_view.sum()) for light in lights) / FPS / 3600


def _conflict_figures(lights: Sequence[LightRecord]) -> dict[str, int]:
    judged = [(light.conflicts.fair, *light.missed_and_late()) for light in lights]
    fair, missed, late = (np.concatenate([j[i] for j in judged]) for i in range(3))
    return {
        "real_conflicts": len(fair),
        "missed": int(missed.sum()),
        "late": int(late.sum()),
        "fair_conflicts": int(fair.sum()),
        "fair_missed": int((missed & fair).sum()),
        "fair_late": int((late & fair).sum()),
    }


def _metric_figures(truth: GroundTruthFrames, lights: Sequence[LightRecord]) -> dict[str, Any]:
    """The metrics of the shown state; specificity raw, shown (held frames apart), and strict."""
    raw = np.concatenate([light.raw for light in lights])
    states = np.concatenate([light.states for light in lights])
    metrics = measure(truth, states, raw).as_dict()
    return {key: metrics[key] for key in _METRICS}


def _per(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None
