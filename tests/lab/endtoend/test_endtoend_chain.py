"""Drawn scenarios through the deployed loop, and the ablation from the scripted run to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn_detectors import OracleDetector

from bikeped.config.load import LoadedConfig, load_config
from bikeped.lab.endtoend.ablation import run_ablation, states_from_boxes
from bikeped.lab.endtoend.measures import (
    MIN_VISIBLE,
    collect_observations,
    localisation_rows,
    recall_rows,
)
from bikeped.lab.endtoend.report import end_to_end_result, verdict
from bikeped.lab.endtoend.run import EndToEndRun, run_scenario
from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
from bikeped.lab.scenarios.scenario import Scenario, bundled_folder, load_scenarios
from bikeped.lab.simulation.suite import Suite
from bikeped.lab.simulation.truth import compute_ground_truth
from bikeped.types import Detections, Kind

SIZE = (960, 540)


@pytest.fixture(scope="module")
def loaded() -> LoadedConfig:
    return load_config()


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """The shortest one in which somebody must be warned."""
    known = sorted(load_scenarios(bundled_folder()), key=lambda s: s.duration_s)
    return next(s for s in known if compute_ground_truth(s).actionable.any())


@pytest.fixture(scope="module")
def run(loaded: LoadedConfig, scenario: Scenario) -> EndToEndRun:
    """With an detector that sees all that can be seen, and one bush that it takes for a walker."""
    painter = ScenePainter(scenario, scene_camera(loaded, SIZE), Conditions())
    times = scenario.frame_times().tolist()

    def boxes(frame: int) -> Detections:
        seen = [o for o in painter.objects(times[frame]) if o.visible >= MIN_VISIBLE]
        kinds = [int(o.label) for o in seen] + [int(Kind.PEDESTRIAN)]
        corners = [o.box_px for o in seen] + [(3.0, 380.0, 9.0, 400.0)]
        return Detections(
            np.asarray(kinds, np.int8),
            np.ones(len(kinds), np.float32),
            np.asarray(corners, np.float32),
        )

    return run_scenario(loaded, scenario, Conditions(), SIZE, OracleDetector(boxes))


def test_every_frame_is_decided_once(run: EndToEndRun, scenario: Scenario) -> None:
    frames = len(scenario.frame_times())
    assert len(run.state) == len(run.objects) == len(run.detections) == frames


def test_a_perfect_detector_loses_nothing_between_occlusion_and_its_boxes(
    run: EndToEndRun, scenario: Scenario, loaded: LoadedConfig
) -> None:
    suite = Suite.load([scenario], loaded)
    steps = {r.name: r for r in run_ablation(suite, [run], loaded, loaded.config.decision)}
    for name in ("misses", "boxes", "kinds"):
        np.testing.assert_array_equal(steps[name].states, steps["occlusion"].states)
    # The bush is a pedestrian for ever: nobody is IDLE with it.
    assert not (steps["false detections"].states[5:] == 0).any()
    assert steps["false detections"].metrics.sensitivity == pytest.approx(
        steps["scripted"].metrics.sensitivity, abs=0.35
    )


def test_the_loop_and_the_ablation_decide_alike(
    run: EndToEndRun, scenario: Scenario, loaded: LoadedConfig
) -> None:
    """The last step comes out of the loop, the others out of its tracker: same boxes and states."""
    from bikeped.pipeline.track_and_decide import TrackAndDecide

    track_and_decide = TrackAndDecide(
        loaded, cyclist_box_includes_rider=run.cyclist_box_includes_rider
    )
    again = states_from_boxes(track_and_decide, run, lambda r, f: r.detections[f])
    np.testing.assert_array_equal(again, [run.state, run.raw_state])


def test_measures_of_a_perfect_detector(
    run: EndToEndRun, scenario: Scenario, loaded: LoadedConfig
) -> None:
    suite = Suite.load([scenario], loaded)
    seen = collect_observations([run], suite.perception_results, loaded)
    assert seen.false[Kind.PEDESTRIAN] == len(run.state)
    assert seen.false[Kind.CYCLIST] == seen.false[Kind.VEHICLE] == 0
    rows = [r for r in recall_rows(seen) if r["seen"]]
    assert rows
    assert all(r["recall"] == r["found"] == 1.0 for r in rows)
    for row in localisation_rows(seen):
        if row["found"]:
            assert row["mean_m"] == pytest.approx(row["exact_box_mean_m"], abs=1e-5)
    near = (seen.kind == Kind.PEDESTRIAN) & (seen.distance_m < 15)
    assert np.nanmean(seen.exact_m[near]) < 1.0


def test_an_eye_that_sees_nothing_is_named(
    run: EndToEndRun, scenario: Scenario, loaded: LoadedConfig
) -> None:
    blind = replace(
        run,
        detections=tuple(Detections.empty() for _ in run.detections),
        state=np.zeros_like(run.state),
        raw_state=np.zeros_like(run.state),
    )
    suite = Suite.load([scenario], loaded)
    steps = run_ablation(suite, [blind], loaded, loaded.config.decision)
    assert steps[-1].metrics.sensitivity == 0.0
    text = verdict(steps)
    assert "misses" in text
    assert "not within 3 points" in text
    seen = collect_observations([blind], suite.perception_results, loaded)
    result = end_to_end_result(suite, [blind], steps, seen, {"light": "day"})
    assert result.data["goal"]["holds"] is False
    assert result.data["stages"][0]["name"] == "scripted"
    assert {t.name for t in result.tables} == {"stages", "scenarios", "recall", "localisation"}
