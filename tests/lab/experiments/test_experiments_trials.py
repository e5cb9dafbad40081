"""Monte Carlo and latency: the shortcuts against the plain way, and nothing left to chance."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from detection_losses import misses

from bikeped.config.load import load_config
from bikeped.errors import BikepedError
from bikeped.lab.experiments import trials
from bikeped.lab.experiments import trials as mc
from bikeped.lab.experiments.latency import (
    DELAYS_MS,
    PREDICTORS,
    delay_frames,
    sweep,
    sweep_with_loss,
)
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.simulation.metrics import measure
from bikeped.lab.simulation.perception import RecallModel, load_recall_curve, trial_generator
from bikeped.lab.simulation.simulate import (
    DetectionSequence,
    build_rule_input,
    delay_history,
    outcome,
    track,
)
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite

CONFIG = Path(__file__).parents[3] / "config.yaml"
NAMES = ("Bike Approaches Ped", "Multiple VRUs", "Safe Crossing", "Swerving Cyclist")
TWO = {name: CONFIGURATIONS[name] for name in ("selected", "narrow")}


@pytest.fixture(scope="module")
def suite() -> Suite:
    scenarios = [s for s in load_scenarios(bundled_folder()) if s.name in NAMES]
    assert len(scenarios) == len(NAMES)
    return Suite.load(scenarios, load_config(CONFIG))


def comparable(result: mc.ExperimentResult) -> str:
    return json.dumps(result.data, sort_keys=True, allow_nan=False)


def test_processes_and_order_of_scenarios_change_nothing(suite: Suite) -> None:
    once = mc.montecarlo(suite, TWO, trials=5, seed=3)
    shuffled = Suite(tuple(suite.scenarios[i] for i in (2, 0, 3, 1)), suite.camera, suite.tracker)
    two = mc.montecarlo(shuffled, TWO, trials=5, seed=3, processes=2)
    assert comparable(two) == comparable(once)
    assert comparable(mc.montecarlo(suite, TWO, trials=5, seed=4)) != comparable(once)


def test_size_of_batches_changes_nothing(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = mc.montecarlo(suite, TWO, trials=5)
    monkeypatch.setattr(trials, "BATCH_BYTES", 1)
    assert comparable(mc.montecarlo(suite, TWO, trials=5)) == comparable(whole)


@pytest.mark.parametrize("burst", [None, 5.0])
def test_a_trial_is_what_it_is_alone(suite: Suite, burst: float | None) -> None:
    """One scenario, one trial, one lane at a time, and the same figures."""
    ordered = trials.sorted_suite(suite)
    plan = trials.LossModel(RecallModel("size"), burst)
    found = trials.run_trials(ordered, [plan], TWO, 3, 7)[0][0, 0]
    missed = {m.false_negative for m in found["selected"]}
    assert len(missed | {ordered.measure(TWO["selected"]).false_negative}) > 1
    for trial in range(3):
        for name, decision in TWO.items():
            parts = []
            for scenario, seen in zip(ordered.scenarios, ordered.perception_results, strict=True):
                kinds = np.broadcast_to(seen.kind, seen.area_px2.shape)
                recall = plan.recall.recall(kinds, seen.area_px2)
                rng = trial_generator(7, scenario.name, trial)
                lost = misses(recall, seen.present, rng, burst)
                scene = DetectionSequence(seen.observed_m, seen.present & ~lost, seen.kind)
                rows = build_rule_input(track([scene], suite.tracker))
                found_alone = outcome(rows, suite.tracker.rule(decision))
                parts.append((found_alone.states, found_alone.raw))
            alone = measure(
                ordered.truth_frames, *(np.concatenate(p) for p in zip(*parts, strict=True))
            )
            assert alone.as_dict() == found[name][trial].as_dict()


def test_every_third_detection_or_so_is_lost_as_recall_says(suite: Suite) -> None:
    """Bursts are longer, yet as many detections are lost."""
    seen = suite.perception_results[1]
    observed = trials.DetectableObjects(
        "x", seen.observed_m, np.full(seen.area_px2.shape, 0.7), seen.present, seen.kind
    )
    for burst in (None, 5.0):
        scenes = observed.trials(range(200), 0, burst)
        rate = np.mean([s.detected[seen.present].mean() for s in scenes])
        assert rate == pytest.approx(0.7, abs=0.01)


@pytest.mark.parametrize("frames", [0, 1, 6, 10_000])
def test_a_late_report_is_the_report_of_late_detections(suite: Suite, frames: int) -> None:
    rng = np.random.default_rng(1)
    scenes = [
        DetectionSequence(s.observed_m, s.present & (rng.random(s.present.shape) < 0.7), s.kind)
        for s in suite.perception_results
    ]
    plain = track([replace(s, delay_frames=frames) for s in scenes], suite.tracker)
    quick = delay_history(track(scenes, suite.tracker), frames)
    if frames >= len(plain.reported):  # nothing comes: the trackers have as many slots as they need
        assert not quick.reported.any()
        assert not plain.reported.any()
        return
    np.testing.assert_array_equal(quick.reported, plain.reported)
    np.testing.assert_array_equal(quick.delay_frames, plain.delay_frames)
    at = plain.reported
    np.testing.assert_array_equal(quick.id[at], plain.id[at])
    np.testing.assert_array_equal(quick.kind[at], plain.kind[at])
    for name in ("xy_m", "velocity_mps", "acceleration_mps2"):
        np.testing.assert_allclose(getattr(quick, name)[at], getattr(plain, name)[at], atol=1e-9)


def test_sweep_is_each_delay_alone(suite: Suite) -> None:
    decision = CONFIGURATIONS["selected"]
    result = sweep(suite, decision)
    assert result.data["delay_ms"] == list(range(0, 496, 33))
    for at in (0, 6, 15):
        frames = delay_frames(DELAYS_MS[at])
        assert frames == at
        tracked = track(suite.detection_sequences(delay_frames=frames), suite.tracker)
        for name, order in PREDICTORS.items():
            found = outcome(build_rule_input(tracked, order), suite.tracker.rule(decision))
            alone = measure(suite.truth_frames, found.states, found.raw)
            for figure in ("sensitivity", "specificity", "sev_fn", "contact_sensitivity"):
                assert result.data[name][figure][at] == alone.as_dict()[figure]
    first = result.data["none"]["sensitivity"][0]
    assert first == suite.measure(decision).sensitivity
    assert result.data["second"]["sensitivity"][0] == first  # nothing to predict over
    assert result.data["none"]["contact_sensitivity"][-1] < 0.9 * first


def test_loss_and_latency_together(suite: Suite) -> None:
    decision = CONFIGURATIONS["selected"]
    found = sweep_with_loss(suite, decision, (0, 198), trials=4, seed=2)
    assert comparable(found) == comparable(
        sweep_with_loss(suite, decision, (0, 198), trials=4, seed=2, processes=2)
    )
    lists = found.data["predictors"]["first"]["sensitivity"]
    assert set(lists) == {"mean", "low", "high", "sd", "p2_5", "p97_5"}
    assert all(len(values) == 2 for values in lists.values())
    # Without delay it is Monte Carlo's figure of the same seed.
    same = mc.montecarlo(suite, {"selected": decision}, trials=4, seed=2).data["rows"]
    row = next(r for r in same if (r["loss"], r["recall"]) == ("independent", "size"))
    assert lists["mean"][0] == row["metrics"]["sensitivity"]["mean"]


def test_summary_is_students() -> None:
    told = trials.summarize([1.0, 2.0, 3.0, 4.0, math.nan])
    assert told["trials"] == 4
    assert told["mean"] == 2.5
    assert told["sd"] == pytest.approx(1.2909944)
    assert told["low"] == pytest.approx(2.5 - 3.1824463 * 1.2909944 / 2, abs=1e-6)
    assert told["high"] == pytest.approx(2.5 + 3.1824463 * 1.2909944 / 2, abs=1e-6)
    assert told["p2_5"] == pytest.approx(1.075)
    assert trials.summarize([2.0])["low"] is None
    assert trials.summarize([math.nan])["mean"] is None


def test_recall_curve_files(tmp_path: Path) -> None:
    wanted = ((100.0, 5000.0), (0.4, 0.9))
    texts = {
        "a.csv": "area,recall\n100,0.4\n5000,0.9\n",
        "b.json": "[[100, 0.4], [5000, 0.9]]",
        "c.json": '{"area_px2": [100, 5000], "recall": [0.4, 0.9]}',
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        assert load_recall_curve(tmp_path / name) == wanted
    bad = {
        "d.csv": "100,0.4\n90,0.5\n",
        "e.csv": "100,0.4\n",
        "f.csv": "100,0.4\n200,1.5\n",
        "g.csv": "a\nb\nc\n",
        "h.json": "{}",
        "i.json": "nonsense",
        "j.csv": "1,nan\n2,0.5\n",
    }
    for name, text in bad.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(BikepedError, match=name):
            load_recall_curve(tmp_path / name)
    with pytest.raises(BikepedError, match="recall-curve"):
        load_recall_curve(tmp_path / "missing.csv")


def test_curve_is_used_and_comes_last(suite: Suite) -> None:
    sharp = ((0.0, 1.0), (1.0, 1.0))
    found = mc.montecarlo(suite, TWO, trials=2, curve=sharp)
    assert {r["recall"] for r in found.data["rows"]} == {"flat", "size", "curve"}
    assert found.data["by_scenario_of"]["recall"] == "curve"
    row = next(r for r in found.data["rows"] if r["recall"] == "curve")
    assert row["configuration"] == "selected"
    assert row["metrics"]["sensitivity"]["mean"] == suite.measure(TWO["selected"]).sensitivity
    assert list(found.data["by_scenario"]) == list(suite.names)
