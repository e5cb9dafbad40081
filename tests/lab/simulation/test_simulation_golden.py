"""Every decision of the selected configuration on the 24, written down: a change is a diff.

`python tests/lab/simulation/test_simulation_golden.py` writes tests/lab/simulation/golden/ anew.
One file a scenario, one line per stretch of frames with the same state and pair: when it begins,
how many frames it lasts, the state, and in ALERT and WARNING the deciding pair (tracks, in the
order of their birth) with its distance at the first and last frame of the stretch.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from bikeped.config.build import rule_settings
from bikeped.config.load import load_config
from bikeped.decision.decider import Decider
from bikeped.decision.who_counts import counts
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.simulation.simulate import FPS, SimulatedTracker
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite
from bikeped.tracking.tracker import Tracker
from bikeped.types import GroundPoints

HERE = Path(__file__).parent
GOLDEN = HERE / "golden"
FILES = {p.stem: p for p in sorted(bundled_folder().glob("*.yaml"))}
REMEDY = "if the change is meant: python tests/lab/simulation/test_simulation_golden.py"


def trace(name, scene):
    """The golden text of one scene, by the deployed tracker and decider."""
    tracker = Tracker(SimulatedTracker.of(load_config(None)).settings)
    decider = Decider(rule_settings(CONFIGURATIONS["selected"]))
    stretches = []
    for frame, there in enumerate(scene.detected):
        points = GroundPoints(scene.kind[there], scene.xy_m[frame][there], np.flatnonzero(there))
        tracks = tracker.update(points, frame / FPS)
        velocity_mps, _ = tracker.smoothed()
        counted = counts(tracks.unseen_s, tracker.parked(), decider.settings.max_unseen_s)
        decision = decider.decide(
            frame / FPS, tracks.id, tracks.kind, tracks.xy_m, velocity_mps, counted
        )
        pair = decision.pair
        key = decision.state.name, pair and (pair.cyclist_id, pair.pedestrian_id)
        distance = pair and pair.distance_m
        if stretches and stretches[-1]["key"] == key:
            stretches[-1].update(last=frame, end_m=distance)
        else:
            stretches.append(
                {"key": key, "first": frame, "last": frame, "start_m": distance, "end_m": distance}
            )
    lines = [f"# {name}: from (s), frames, state, pair, distance (m)"]
    for s in stretches:
        state, pair = s["key"]
        line = f"{s['first'] / FPS:7.3f} {s['last'] - s['first'] + 1:4d}  {state}"
        if pair:
            who = f"cyclist {pair[0]}, pedestrian {pair[1]}"
            line = f"{line:<21s} {who:<24s} {s['start_m']:6.2f} -> {s['end_m']:5.2f}"
        lines.append(line)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("slug", FILES)
def test_decisions_are_as_written_down(suite, slug):
    index = [Path(s.source).stem for s in suite.scenarios].index(slug)
    found = trace(suite.names[index], suite.detection_sequences()[index])
    assert found == (GOLDEN / f"{slug}.txt").read_text(encoding="utf-8"), REMEDY


def test_there_is_a_trace_for_every_scenario_and_no_other():
    assert {p.stem for p in GOLDEN.iterdir()} == set(FILES)


def main():
    GOLDEN.mkdir(exist_ok=True)
    for old in GOLDEN.glob("*.txt"):
        old.unlink()
    loaded = load_config(HERE.parents[2] / "config.yaml")
    suite = Suite.load(load_scenarios(bundled_folder()), loaded)
    for scenario, scene in zip(suite.scenarios, suite.detection_sequences(), strict=True):
        slug = Path(scenario.source).stem
        (GOLDEN / f"{slug}.txt").write_text(trace(scenario.name, scene), encoding="utf-8")
    sys.stdout.write(f"{len(suite.scenarios)} traces in {GOLDEN}\n")


if __name__ == "__main__":
    main()
