"""A page on one rule in traffic, in one file: every alert to step through, nuisance first.

Plan and strips are the test bench's; each alert is a clip from 3 s before to 1 s after it, at 10
frames a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from markupsafe import Markup

from bikeped import __version__
from bikeped.config.build import rule_settings
from bikeped.config.schema import DecisionConfig
from bikeped.decision.decider import explain, pair_metrics, select_pair
from bikeped.decision.rules import PairChecks, RuleSettings
from bikeped.lab.experiments.report import table_html
from bikeped.lab.result_tables import ExperimentResult
from bikeped.lab.simulation.light_record import LightRecord
from bikeped.lab.simulation.simulate import FPS, verdicts
from bikeped.lab.simulation.truth import KIND_OF
from bikeped.lab.testbench.comparison import encode_runs
from bikeped.lab.testbench.export import FOLDERS, inline_files, page_policy
from bikeped.lab.testbench.playback import TESTS, coverage
from bikeped.lab.traffic.suite import TrafficSuite
from bikeped.templates import render
from bikeped.types import FloatArray, IntArray, Kind, State

_SCRIPTS = (
    *("ui.js", "canvas.js", "testbench-words.js", "testbench-timeline.js", "testbench-plan.js"),
    "traffic.js",
)
_STYLES = ("app.css", "testbench.css", "report.css", "traffic.css")
#: Every third frame is in a clip; it begins and ends so long before and after the alert, seconds.
_STEP, _BEFORE_S, _AFTER_S = 3, 3.0, 1.0
_FIRES = 1 << list(TESTS).index("fires")
#: Numbers of a pair that the plan does not draw.
_UNUSED = ("then_m", "lookback_s", "displacement_m", "speed_mps", "d_max_m", "reach_m")


def render_traffic_page(
    suite: TrafficSuite, rule: str, decision: DecisionConfig, result: ExperimentResult, command: str
) -> str:
    """The page on the rule named `rule`; `result` has the figures, `command` repeats the run."""
    lights, settings = suite.lights(decision), rule_settings(decision)
    found = verdicts(suite.rule_input, settings)
    scenes, alerts = [], []
    for index, light in enumerate(lights):
        strip = {
            "name": suite.names[index],
            "frames": len(light.raw),
            "truth": encode_runs(light.truth.danger.astype(int).tolist()),
            "after": encode_runs(light.states.tolist()),
        }
        camera = coverage(suite.camera, suite.scenes[index].pose)
        scenes.append({"strip": strip, "cameras": [camera]})
        alerts += _alerts(suite, index, light, found, settings)
    # Nuisance first; among equals in the order of scenes and time.
    alerts.sort(key=lambda alert: ("nuisance", "conflict", "danger").index(alert["kind"]))
    style, theme, script = inline_files(_STYLES, _SCRIPTS)
    # "<" could end the script element; \\u003c is the same JSON.
    data = msgspec.json.encode({"scenes": scenes, "alerts": alerts}).decode()
    return render(
        "traffic.html",
        *(folder / "templates" for folder in FOLDERS),
        version=__version__,
        rule=rule,
        policy=page_policy(style, theme, script),
        style=Markup(style),
        theme=Markup(theme),
        script=Markup(script),
        data=Markup(data.replace("<", "\\u003c")),
        tables=Markup("").join(map(table_html, result.tables)),
        count=len(alerts),
        nuisance=sum(alert["kind"] == "nuisance" for alert in alerts),
        noise=suite.noise,
        command=command,
    )


def _alerts(
    suite: TrafficSuite, index: int, light: LightRecord, found: PairChecks, settings: RuleSettings
) -> list[dict[str, Any]]:
    """Every alert of a scene as a clip."""
    episodes = light.episodes()
    alerts = []
    for (begin, end), danger, conflict in zip(
        episodes.frames.tolist(), episodes.danger, episodes.conflict, strict=True
    ):
        first = max(begin - round(_BEFORE_S * FPS), 0)
        last = min(end + round(_AFTER_S * FPS), len(light.raw))
        frames = np.arange(first, last, _STEP)
        nearest_m = light.truth.nearest_m[begin:end].min()
        kind = "danger" if danger else "conflict" if conflict else "nuisance"
        alerts.append(
            {
                "scene": index,
                "kind": kind,
                "begin_s": begin / FPS,
                "seconds": (end - begin) / FPS,
                "first_s": first / FPS,
                "onset": (begin - first + _STEP - 1) // _STEP,
                "nearest_m": float(nearest_m) if np.isfinite(nearest_m) else None,
                "danger": light.truth.danger[frames].tolist(),
                **_clip(suite, index, light, frames, found, settings),
            }
        )
    return alerts


def _clip(
    suite: TrafficSuite,
    index: int,
    light: LightRecord,
    frames: IntArray,
    found: PairChecks,
    settings: RuleSettings,
) -> dict[str, Any]:
    """What the plan draws in these frames, in the form of a playback, and a sentence for each."""
    run, pose = suite.rule_input, suite.scenes[index].pose
    begin = int(run.start[index])
    pair_frame = run.rows.frame[run.pairs.pedestrian_row]
    tracks: dict[str, list[Any]] = {"start": [0], "id": [], "kind": [], "xy": []}
    pairs: dict[str, list[Any]] = {"start": [0], "cyclist": [], "pedestrian": []}
    pairs |= {"passes": [], "distance_m": [], **{name: [] for name in _UNUSED}}
    sentences, chosen = [], []
    for frame in (begin + frames).tolist():
        low, high = run.rows.frame.searchsorted([frame, frame + 1])
        rows = slice(int(low), int(high))
        tracks["id"] += run.rows.id[rows].tolist()
        tracks["kind"] += [Kind(k).label for k in run.rows.kind[rows].tolist()]
        tracks["xy"] += _flat(pose.ground_to_world(run.rows.xy_m[rows]))
        tracks["start"].append(len(tracks["id"]))
        first, last = map(int, pair_frame.searchsorted([frame, frame + 1]))
        state = State(int(light.raw[frame - begin]))
        at = select_pair(state, found.fires[first:last], found.distance_m[first:last])
        metrics = (
            None if at is None else pair_metrics(first + at, run.rows, run.pairs, found, settings)
        )
        walking = int((run.rows.kind[rows] == int(Kind.PEDESTRIAN)).sum())
        since_s = float(run.time_s[frame] - run.cyclist_last_s[frame])
        sentences.append(explain(state, metrics, walking, since_s, settings))
        drawn = np.flatnonzero(found.fires[first:last]).tolist()
        drawn += [at] if at is not None and at not in drawn else []
        chosen.append(-1 if at is None else len(pairs["cyclist"]) + drawn.index(at))
        for pair in (first + i for i in drawn):
            cyclist = run.pairs.cyclist_row[run.pairs.cyclist[pair]]
            pairs["cyclist"].append(int(run.rows.id[cyclist]))
            pairs["pedestrian"].append(int(run.rows.id[run.pairs.pedestrian_row[pair]]))
            pairs["passes"].append(_FIRES if found.fires[pair] else 0)
            pairs["distance_m"].append(round(float(found.distance_m[pair]), 2))
        pairs["start"].append(len(pairs["cyclist"]))
    return {
        "agents": _agents(suite, index, frames),
        "tracks": tracks,
        "side": {"state": light.states[frames].tolist(), "chosen": chosen, "pairs": pairs},
        "raw": light.raw[frames].tolist(),
        "sentence": sentences,
    }


def _agents(suite: TrafficSuite, index: int, frames: IntArray) -> list[dict[str, Any]]:
    """Those who are there in these frames, with their detections."""
    scene, detections = suite.scenes[index], suite.detections[index]
    time_s = frames / FPS
    agents = []
    for i, agent in enumerate(scene.scenario.agents):
        xy, heading, there = agent.sample(time_s)
        if not there.any():
            continue
        detected = detections.detected[frames, i]
        put = scene.pose.ground_to_world(
            np.where(detected[:, None], detections.xy_m[frames, i], np.nan)
        )
        present = suite.perception_results[index].present[frames, i]
        agents.append(
            {
                "id": agent.id,
                "kind": agent.kind,
                "role": KIND_OF[agent.kind].label,
                "size_m": list(agent.size_m),
                "true": _flat(xy),
                "heading": [None if h != h else round(h, 2) for h in heading.tolist()],
                "detected": _flat(put),
                "missed": (present & ~detected).astype(int).tolist(),
                "path": [[0, *p] for p in np.round(xy[there][::5], 2).tolist()],
            }
        )
    return agents


def _flat(xy: FloatArray | Sequence[Sequence[float]]) -> list[float | None]:
    """[x0, y0, x1, y1, ...] in centimetres; null where not finite."""
    values = np.round(np.asarray(xy, np.float64).reshape(-1), 2).tolist()
    return [None if v != v else v for v in values]
