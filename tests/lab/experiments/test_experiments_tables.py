"""The experiments without chance, the optimiser, and where cameras stand."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from bikeped.config.load import load_config, parse_decision
from bikeped.errors import ScenarioError
from bikeped.lab.experiments import deployment as dep
from bikeped.lab.experiments import deterministic as ex
from bikeped.lab.experiments import optimizer as opt
from bikeped.lab.scenarios.scenario import SIZES_M, bundled_folder, load_scenarios
from bikeped.lab.simulation.perception import RecallModel, localise, simulate_perception
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite
from bikeped.lab.simulation.truth import compute_ground_truth

CONFIG = Path(__file__).parents[3] / "config.yaml"
NAMES = ("Bike Approaches Ped", "Multiple VRUs", "Safe Crossing", "Swerving Cyclist")
SELECTED = CONFIGURATIONS["selected"]
LOADED = load_config(CONFIG)


@pytest.fixture(scope="module")
def suite() -> Suite:
    scenarios = [s for s in load_scenarios(bundled_folder()) if s.name in NAMES]
    return Suite.load(scenarios, LOADED)


def test_run_tells_each_scenario_and_the_totals(suite: Suite) -> None:
    result = ex.run_table(suite, SELECTED)
    json.dumps(result.data, allow_nan=False)
    metrics = suite.measure(SELECTED)
    assert result.data["metrics"] == metrics.as_dict()
    rows = {row["scenario"]: row for row in result.data["scenarios"]}
    assert set(rows) == set(NAMES)
    safe = rows["Safe Crossing"]
    assert safe["actionable_frames"] == 0
    assert safe["sensitivity"] is None
    for row in rows.values():
        assert sum(row["states"].values()) == pytest.approx(1)
        assert row["states"][row["dominant"]] == max(row["states"].values())
    assert result.tables[1].rows[0][0] == round(100 * metrics.sensitivity, 1)


def test_one_scenario_by_name(suite: Suite) -> None:
    assert ex.select_scenario(suite, "swerving cyclist").names == ("Swerving Cyclist",)
    with pytest.raises(ScenarioError, match="did you mean 'Swerving Cyclist'"):
        ex.select_scenario(suite, "Swerving Ciclist")


def test_errors_table_and_map_agree_with_the_camera(suite: Suite) -> None:
    data = ex.localisation_errors(suite).data
    assert len(data["table"]) == 3 * 7 * 4
    part = data["map"]["cyclist"]
    i, j = part["x_m"].index(8.0), part["y_m"].index(-3.0)
    point = np.array([[8.0, -3.0]])
    put, _ = localise(suite.camera, point, np.array([[0.0, 1.0]]), SIZES_M["cyclist"])
    assert part["error_m"][i][j] == pytest.approx(float(np.hypot(*(put - point)[0])))
    straight = next(
        r
        for r in data["table"]
        if (r["kind"], r["distance_m"], r["bearing_deg"]) == ("cyclist", 8, 0)
    )
    assert part["error_m"][i][part["y_m"].index(0.0)] == pytest.approx(straight["error_m"])
    assert (len(part["error_m"]), len(part["error_m"][0])) == (50, 101)
    assert part["error_m"][0][50] is None  # half a metre ahead, below the view


def test_truth_rows_vary_one_threshold_each(suite: Suite) -> None:
    rows = ex.truth_sensitivity(suite, SELECTED).data["rows"]
    assert [(r["parameter"], r["value"], r["default"]) for r in rows] == [
        ("cpa_radius_m", 3.0, False),
        ("cpa_radius_m", 5.0, True),
        ("cpa_radius_m", 7.0, False),
        ("stopping_margin", 0.6, False),
        ("stopping_margin", 0.8, True),
        ("stopping_margin", 1.0, False),
        ("ttc_bound_s", 2.0, False),
        ("ttc_bound_s", 3.0, False),
        ("ttc_bound_s", 4.0, False),
        ("ttc_bound_s", None, True),
    ]
    own = suite.measure(SELECTED).as_dict()
    for row in rows:
        same = {key: row[key] for key in own} == own
        assert same or not row["default"]
    danger = [r["true_positive"] + r["false_negative"] for r in rows]
    assert danger[3] > danger[4] > danger[5] or danger[3] >= danger[4] >= danger[5]
    # The straightforward way: a suite made afresh under the thresholds.
    fresh = Suite(
        suite.scenarios,
        suite.camera,
        suite.tracker,
        truth_settings=ex.GroundTruthSettings(stopping_margin=0.6),
    )
    alone = fresh.measure(SELECTED).as_dict()
    assert {key: rows[3][key] for key in alone} == alone


def test_braking_profiles(suite: Suite) -> None:
    rows = {r["profile"]: r["metrics"] for r in ex.braking_profiles(suite, SELECTED).data["rows"]}
    assert list(rows) == ["scenario", "bicycle", "ebike", "aashto"]
    assert rows["scenario"] == suite.measure(SELECTED).as_dict()
    positives = {k: m["true_positive"] + m["false_negative"] for k, m in rows.items()}
    assert positives["ebike"] < positives["bicycle"] < positives["aashto"]


@pytest.mark.parametrize(
    ("budget", "name"),
    [
        (None, "below"),
        (0.84, "below"),
        (0.85, "above attentive"),
        (1.87, "above attentive"),
        (1.88, "above distracted"),
    ],
)
def test_budget_class(budget: float | None, name: str) -> None:
    assert ex.budget_class(budget) == name


def test_budgets_are_those_of_the_metrics(suite: Suite) -> None:
    rows = ex.warning_budgets(suite, SELECTED).data["rows"]
    metrics = suite.measure(SELECTED)
    assert [r["scenario"] for r in rows] == [
        n for n, t in zip(suite.names, suite.truths, strict=True) if t.actionable.any()
    ]
    for row in rows:
        i = suite.names.index(row["scenario"])
        assert row["mean"] == pytest.approx(np.mean(row["onsets"]))
        assert row["min"] == min(row["onsets"]) == metrics.by_scenario["min_warning_budget_s"][i]


def test_cost_is_the_definition(suite: Suite) -> None:
    metrics = replace(
        suite.measure(SELECTED),
        sev_fn=0.1,
        specificity=0.9,
        mean_alert_latency_s=0.5,
        adequate_share=0.75,
        fatigue=0.3,
        sensitivity=0.8,
    )
    assert opt.cost(metrics) == pytest.approx(0.5 + 0.1 + 1.0 + 0.75 + 0.1 + 2.0)
    calm = replace(metrics, fatigue=0.1, sensitivity=0.95, adequate_share=math.nan)
    assert opt.cost(calm) == pytest.approx(0.5 + 0.1 + 1.0 + 3.0)


def test_optimiser_keeps_to_its_bounds_seed_and_trace(suite: Suite) -> None:
    base = msgspec.structs.replace(SELECTED, reaction_s=1.1)
    counts: list[int] = []
    first = opt.optimize(suite, base, maxiter=2, popsize=4, progress=counts.append)
    data = first.data
    json.dumps(data, allow_nan=False)
    assert counts == list(range(1, opt.evaluations(2, 4) + 1))
    assert data["evaluations"] == 5 * 4 * 3
    for key, (low, high) in data["bounds"].items():
        assert low <= data["decision"][key] <= high
    assert isinstance(data["decision"]["memory_frames"], int)
    assert isinstance(data["decision"]["lookback_frames"], int)
    assert data["decision"]["reaction_s"] == 1.1
    costs = [cost for _, cost in data["trace"]]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] == data["cost"]
    assert opt.optimize(suite, base, maxiter=2, popsize=4).data == data
    assert opt.optimize(suite, base, seed=1, maxiter=2, popsize=4).data["trace"] != data["trace"]
    text = opt.candidate_yaml(first, suite.hash, LOADED.hash)
    again = parse_decision(text, "candidate")
    assert msgspec.to_builtins(again) == data["decision"]
    assert opt.cost(suite.measure(again)) == data["cost"]


def test_the_bounds_are_the_definition() -> None:
    assert [(b.low, b.high, b.whole) for b in opt.BOUNDS] == [
        (0, 120, True),
        (0.5, 5, False),
        (5, 25, False),
        (0.01, 0.5, False),
        (1, 10, True),
    ]
    assert opt.evaluations() >= 3000


def test_optimiser_refuses_a_suite_without_danger(suite: Suite) -> None:
    with pytest.raises(ScenarioError, match="no scenario has an actionable"):
        opt.optimize(ex.select_scenario(suite, "Safe Crossing"), SELECTED, maxiter=1, popsize=2)


@pytest.mark.parametrize("width", dep.WIDTHS_FT)
def test_road_scenario_meets_in_the_middle(width: int) -> None:
    scenario = dep.road_scenario(width)
    walk, ride = scenario.agents
    meet = width * 0.3048 / 2 / 1.3
    for agent in (walk, ride):
        found = agent.at(meet)
        assert found is not None
        np.testing.assert_allclose(found[0], [5.0, 0.0], atol=1e-9)
    assert np.hypot(*(ride.path[0, 1:] - [5.0, 0.0])) == pytest.approx(20.0)
    truth = compute_ground_truth(scenario)
    assert truth.actionable.any()
    assert np.isfinite(truth.ttc_s[truth.actionable]).all()


def test_fusion(suite: Suite) -> None:
    scenario = dep.road_scenario(40)
    camera = dep.wide_camera(suite.camera, 5.5, 0.0)
    assert math.degrees(2 * camera.lens.max_theta_rad) == pytest.approx(220)
    near, far = dep.camera_poses(40, 2)
    seen = [simulate_perception(scenario, camera, pose) for pose in (near, far)]
    model = RecallModel("size")
    rate = [model.recall(np.broadcast_to(s.kind, s.area_px2.shape), s.area_px2) for s in seen]
    fused = dep.detectable_objects(scenario, camera, (near, far))
    np.testing.assert_allclose(fused.recall, 1 - (1 - rate[0]) * (1 - rate[1]))
    # Whichever camera an object is taken from, it lies near where it is.
    at = fused.present
    error = np.hypot(*(fused.xy_m - seen[0].true_m)[at].T)
    best = np.where(seen[1].area_px2 > seen[0].area_px2, seen[1].error_m, seen[0].error_m)
    np.testing.assert_allclose(error, best[at], atol=1e-9)
    assert (seen[1].area_px2 > seen[0].area_px2)[at].any()
    strict = dep.detectable_objects(scenario, camera, (near,), visible_only=True)
    hidden = at & (seen[0].area_px2 == 0)
    assert hidden.any()
    assert (strict.recall[hidden] == 0).all()


def test_deployment_rows(suite: Suite) -> None:
    data = dep.deployment(suite.camera, suite.tracker, SELECTED, trials=6).data
    json.dumps(data, allow_nan=False)
    keys = [(r["height_m"], r["cameras"], r["width_ft"]) for r in data["rows"]]
    assert keys == [(h, c, w) for h in (5.5, 2.5) for c in (1, 2) for w in (30, 40, 50, 60)]
    for one, two in zip(data["rows"][:4], data["rows"][4:8], strict=True):
        assert two["sensitivity"]["mean"] > one["sensitivity"]["mean"]
    assert dep.deployment(suite.camera, suite.tracker, SELECTED, trials=6).data == data


def test_placement_grid(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    assert dep.HEIGHTS_M[0] == 1.5
    assert dep.HEIGHTS_M[-1] == 7.5
    assert dep.PITCHES_DEG == (0, -10, -20, -30, -40, -50, -60, -70, -80, -90)
    monkeypatch.setattr(dep, "HEIGHTS_M", (1.5, 5.5))
    monkeypatch.setattr(dep, "PITCHES_DEG", (0.0, -40.0, -90.0))
    data = dep.placement(suite.camera, suite.tracker, SELECTED, trials=3).data
    assert [len(row) for row in data["sensitivity"]] == [3, 3]
    # A cell is the deployment of that mount, the same trials.
    monkeypatch.setattr(dep, "MOUNTS", ((5.5, -40.0),))
    monkeypatch.setattr(dep, "WIDTHS_FT", (40,))
    rows = dep.deployment(suite.camera, suite.tracker, SELECTED, trials=3).data["rows"]
    assert data["sensitivity"][1][1] == rows[0]["sensitivity"]["mean"]
    shown = dep.placement(suite.camera, suite.tracker, SELECTED, trials=3).tables[1]
    assert shown.name == "placement_visible_only"
    assert all(
        v is None or u is None or v <= u + 0.2
        for usual, visible in zip(
            data["sensitivity"], data["visible_only_sensitivity"], strict=True
        )
        for u, v in zip(usual, visible, strict=True)
    )
