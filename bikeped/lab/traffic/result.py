"""`conformance traffic`: rules over scenes of traffic, beside a light that knows danger itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec

from bikeped import __version__
from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig
from bikeped.lab.result_tables import CellValue, ExperimentResult, ResultTable, cells
from bikeped.lab.simulation.light_record import LightRecord, hours_both_in_view, light_figures
from bikeped.lab.simulation.simulate import FPS
from bikeped.lab.traffic.suite import TrafficSuite

FORESIGHT = "foresight"
_ALERT_KEYS = ("alert_on_frames", "alert_window_frames", "alert_hold_s")
#: The nuisance figures that are given as a ratio to foresight's, too.
RATIOS = (
    *("alerts_per_hour", "alerts_per_hour_both_in_view", "red_share", "changes_per_minute"),
    *("changes_per_minute_both_in_view", "red_off_red_per_hour"),
)
_COLUMNS = {
    "alerts/h": "alerts_per_hour",
    "danger, %": "alerts_with_danger",
    "red, %": "red_share",
    "x foresight": "to_foresight.red_share",
    "missed": "missed",
    "late": "late",
    "fair missed": "fair_missed",
    "fair late": "fair_late",
    "sens, %": "sensitivity",
    "spec, %": "specificity",
}
_RED_COLUMNS = {
    "red, %": "red_share",
    "no danger, %": "red_without_danger",
    "over 10 m, %": "red_nearest_pair_far",
    "no pair, %": "red_without_pair",
    "short, %": "episodes_under_500ms",
    "changes/min": "changes_per_minute",
    "red again/h": "red_off_red_per_hour",
}


def with_alert_settings(decision: DecisionConfig, source: DecisionConfig) -> DecisionConfig:
    """A decision with the window and the hold of another: rules are compared through the same."""
    return msgspec.structs.replace(decision, **{key: getattr(source, key) for key in _ALERT_KEYS})


def traffic_result(
    suite: TrafficSuite,
    configurations: Mapping[str, DecisionConfig],
    loaded: LoadedConfig,
    progress: Callable[[int], None] = lambda done: None,
) -> ExperimentResult:
    """Every configuration, shown as the configured decision says, over all scenes and by scene."""
    own = loaded.config.decision
    lights = {FORESIGHT: suite.foresight(own)}
    progress(1)
    for done, (name, decision) in enumerate(configurations.items(), 2):
        lights[name] = suite.lights(with_alert_settings(decision, own))
        progress(done)
    rules: dict[str, Any] = {}
    foresight = [[light] for light in lights[FORESIGHT]]
    for name, found in lights.items():
        by_scene = {
            scene: _beside(known, [light])
            for scene, known, light in zip(suite.names, foresight, found, strict=True)
        }
        rules[name] = {**_beside(lights[FORESIGHT], found), "by_scene": by_scene}
    data = {
        "version": __version__,
        "config_hash": loaded.hash,
        "calibration_hash": loaded.calibration_hash,
        "scenes": len(suite.scenes),
        "hours": sum(len(light.raw) for light in lights[FORESIGHT]) / FPS / 3600,
        "hours_both_in_view": hours_both_in_view(lights[FORESIGHT]),
        "tracker": suite.tracker.name,
        "noise": suite.noise,
        "seed": suite.seed,
        "shown": {
            "on": own.alert_on_frames,
            "window": own.alert_window_frames,
            "hold_s": own.alert_hold_s,
        },
        "rules": rules,
    }
    return ExperimentResult("traffic", data, _tables(suite, rules))


def _beside(foresight: Sequence[LightRecord], lights: Sequence[LightRecord]) -> dict[str, Any]:
    """A rule's figures, and the nuisance among them over those of foresight."""
    figures, known = light_figures(lights), light_figures(foresight)
    ratios = {k: figures[k] / known[k] if figures[k] and known[k] else None for k in RATIOS}
    return {**figures, "to_foresight": ratios}


def _tables(suite: TrafficSuite, rules: Mapping[str, Any]) -> tuple[ResultTable, ...]:
    def table(name: str, title: str, columns: Mapping[str, str], note: str) -> ResultTable:
        rows = [(rule, *_rounded(cells(figures, columns))) for rule, figures in rules.items()]
        return ResultTable(name, title, ("rule", *columns), rows, note)

    count = rules[FORESIGHT]
    conflicts = f"{count['real_conflicts']} real conflicts, {count['fair_conflicts']} of them fair"
    scenes = [
        (scene, rule, *_rounded(cells(figures["by_scene"][scene], _COLUMNS)))
        for scene in suite.names
        for rule, figures in rules.items()
    ]
    return (
        table(
            "traffic",
            f"Rules in traffic ({len(suite.scenes)} scenes, noise {suite.noise})",
            _COLUMNS,
            f"{conflicts}: the pair was in view for 2.2 s before; danger: alerts with danger or a "
            "real conflict; missed: no ALERT in the 5 s before; late: none earlier than 1.87 s "
            "before; foresight: the light that shows the danger label itself",
        ),
        table(
            "traffic_red",
            "When the light is red",
            _RED_COLUMNS,
            "of the red frames: without danger, with the nearest pair beyond 10 m, with no pair in "
            "view; short: alerts under 0.5 s; red again: within 2 s of the last red",
        ),
        ResultTable("traffic_scenes", "By scene", ("scene", "rule", *_COLUMNS), scenes),
    )


def _rounded(values: Sequence[CellValue]) -> list[CellValue]:
    return [round(v, 2) if isinstance(v, float) else v for v in values]
