"""Contest, register, audit: their numbers are those of the suite asked directly."""

import json
import shlex

import numpy as np
import pytest

from bikeped.config.load import load_config
from bikeped.config.schema import DecisionConfig
from bikeped.errors import BikepedError
from bikeped.lab.cli.conformance import command as conformance
from bikeped.lab.governance import register
from bikeped.lab.governance.audit_records import write_audit
from bikeped.lab.governance.what_if import (
    apply_bounds,
    compare_variants,
    parse_truth,
    with_scenarios,
)
from bikeped.lab.scenarios.scenario import parse_scenario
from bikeped.lab.simulation.suite import DEFAULT_GROUND_TRUTH, Suite
from bikeped.types import State

ONE = """
name: One
agents:
  - {id: 1, kind: pedestrian, path: [[0.0, 5.0, -8.0], [9.0, 5.0, 4.0]]}
  - {id: 2, kind: cyclist, path: [[0.5, -13.0, -2.0], [9.0, 32.0, -2.0]]}
"""
TWO = """
name: "Two <b>&|"
hazard: safe
agents:
  - {id: 7, kind: pedestrian, path: [[0.0, 4.0, -6.0], [5.0, 4.0, 2.0]]}
  - {id: 9, kind: cyclist, path: [[1.0, 12.0, -6.0], [5.0, 12.5, 9.0]]}
"""
WEAK = DecisionConfig(d_max_m=9.0, speed_adaptive=False)


@pytest.fixture(scope="module")
def loaded():
    return load_config()


@pytest.fixture(scope="module")
def suite(loaded):
    return Suite.load([parse_scenario(ONE, "one"), parse_scenario(TWO, "two")], loaded)


def test_contest_gives_the_numbers_of_direct_runs(suite):
    found = compare_variants(suite, DecisionConfig(), suite, WEAK).as_dict()
    for key, decision in (("before", DecisionConfig()), ("after", WEAK)):
        metrics, states = suite.measure(decision), suite.states(decision)
        assert found[key]["totals"] == metrics.as_dict()
        for i, name in enumerate(suite.names):
            row = found[key]["by_scenario"][name]
            part = states[suite.rule_input.frame_slice(i)]
            assert row["states"]["ALERT"] == (part == int(State.ALERT)).mean()
            assert sum(row["states"].values()) == pytest.approx(1)
            assert {k: v for k, v in row.items() if k != "states"} == metrics.scenario_dict(i)
    json.dumps(found, allow_nan=False)


def test_changed_frames_and_spans_are_those_of_the_states(suite):
    found = compare_variants(suite, DecisionConfig(), suite, WEAK)
    before, after = suite.states(DecisionConfig()), suite.states(WEAK)
    by_name = {c["scenario"]: c for c in found.changed}
    for i, name in enumerate(suite.names):
        part = suite.rule_input.frame_slice(i)
        differs = before[part] != after[part]
        if not differs.any():
            assert name not in by_name
            continue
        entry = by_name[name]
        assert entry["frames_state"] == differs.sum()
        assert entry["frames_truth"] == 0
        told = np.zeros(len(differs), bool)
        for span in entry["spans"]:
            a, b = round(span["from_s"] * 30), round(span["to_s"] * 30) + 1
            told[a:b] = True
            assert all(before[part][a:b] == int(State[span["before"]]))
            assert all(after[part][a:b] == int(State[span["after"]]))
        assert (told == differs).all()
    assert by_name


def test_nothing_changes_against_itself(suite):
    assert compare_variants(suite, WEAK, suite, WEAK).changed == []


def test_truth_changes_labels_and_not_states(suite):
    other = suite.with_truth(
        parse_truth(DEFAULT_GROUND_TRUTH, ["cpa_radius_m=0.5", "braking=ebike"])
    )
    found = compare_variants(suite, DecisionConfig(), other, DecisionConfig())
    assert found.changed
    assert all(c["frames_state"] == 0 and c["frames_truth"] > 0 for c in found.changed)
    assert found.as_dict()["after"]["truth"]["braking"] == "ebike"


def test_scenarios_are_added_and_replaced(suite):
    new = parse_scenario(ONE.replace("One", "Three"), "three")
    changed = parse_scenario(ONE.replace("32.0", "25.0"), "one")
    other = with_scenarios(suite, [new, changed])
    assert other.names == (*suite.names, "Three")
    found = compare_variants(suite, DecisionConfig(), other, DecisionConfig())
    assert {c["scenario"]: c["what"] for c in found.changed} == {
        "One": "replaced scenario",
        "Three": "new scenario",
    }
    with pytest.raises(BikepedError, match="twice"):
        with_scenarios(suite, [new, new])


@pytest.mark.parametrize(
    ("bound", "value"),
    [
        ("d_max_m=5..15", 15.0),
        ("decision.d_max_m=..15", 15.0),
        ("d_max_m=..30", 24.8),
        ("memory_frames=60.5..70", 61),
        ("memory_frames=0..10.5", 10),
        ("d_min_m=2..", 2.0),
    ],
)
def test_a_bound_moves_a_value_to_its_nearest_end(bound, value):
    key = bound.split("=")[0].removeprefix("decision.")
    assert getattr(apply_bounds(DecisionConfig(), [bound]), key) == value


@pytest.mark.parametrize(
    "bound",
    [
        "d_max_m",
        "d_max_m=..",
        "d_max_m=9..5",
        "rule=1..2",
        "speed_adaptive=0..1",
        "nonsense=1..2",
        "memory_frames=60.2..60.8",
        "d_max_m=..0.5",
        "d_max_m=200..",
        "d_max_m=x..3",
        "__class__=1..2",
    ],
)
def test_a_bad_bound_is_named(bound):
    with pytest.raises(BikepedError, match="--bound"):
        apply_bounds(DecisionConfig(), [bound])


@pytest.mark.parametrize(
    "item",
    [
        "cpa_radius_m",
        "cpa=3",
        "cpa_radius_m=x",
        "cpa_radius_m=-1",
        "cpa_radius_m=nan",
        "braking=tram",
        "ttc_bound_s=0",
    ],
)
def test_a_bad_threshold_is_named(item):
    with pytest.raises(BikepedError, match="--truth"):
        parse_truth(DEFAULT_GROUND_TRUTH, [item])


def run(*arguments):
    try:
        return conformance.main(args=[str(a) for a in arguments], standalone_mode=False) or 0
    except BikepedError as error:
        return error.exit_status


def test_the_printed_command_line_gives_the_same_again(tmp_path, suite):
    folder = tmp_path / "two words"
    folder.mkdir()
    (folder / "one.yaml").write_text(ONE)
    (tmp_path / "two.yaml").write_text(TWO)
    first, again = tmp_path / "a.json", tmp_path / "b.json"
    arguments = ["--scenarios", folder, "--scenario", tmp_path / "two.yaml"]
    arguments += ["--set", "decision.d_max_m=9", "--truth", "cpa_radius_m=7"]
    arguments += ["--bound", "d_min_m=2.."]
    assert run("contest", *arguments, "--json", first) == 0
    data = json.loads(first.read_text())
    words = shlex.split(data["command"])
    assert words[:3] == ["bikeped", "conformance", "contest"]
    assert run(*words[2:], "--json", again) == 0
    assert json.loads(again.read_text()) == data
    assert data["after"]["decision"]["d_min_m"] == 2.0
    assert data["after"]["scenarios"] == 2
    assert data["before"]["scenarios"] == 1


def test_contest_without_a_challenge_is_bad_input(tmp_path):
    assert run("contest") == 2


def test_another_camera_counts_for_the_side_after_only(tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "one.yaml").write_text(ONE)
    out = tmp_path / "o.json"
    assert run("contest", "--scenarios", folder, "--set", "camera.height_m=6", "--json", out) == 0
    data = json.loads(out.read_text())
    plain = Suite.load([parse_scenario(ONE, "one")], load_config())
    higher = Suite.load([parse_scenario(ONE, "one")], load_config(None, ["camera.height_m=6"]))
    decision = load_config().config.decision
    assert data["before"]["totals"] == plain.measure(decision).as_dict()
    assert data["after"]["totals"] == higher.measure(decision).as_dict()


def test_the_register_holds_the_suite_s_figures_and_the_paper_s_hazards(suite):
    found = register.build_register(suite, DecisionConfig())
    metrics = suite.measure(DecisionConfig())
    for i, row in enumerate(found.scenarios):
        assert row["scenario"] == suite.names[i]
        assert row["sensitivity"] == metrics.scenario_dict(i)["sensitivity"]
        assert row["danger_frames"] == int(suite.truths[i].danger.sum())
    ratings = {h["hazard"]: h["field_blocking"] for h in found.hazards}
    assert ratings["Low light or rain"] == "yes"
    assert ratings["Sensor tampered with or failing"] == "yes"
    assert ratings["Wheelchair on a slope"] == "monitor"
    # This suite has no swerving cyclist: then nobody may call it covered.
    swerve = found.hazards[0]
    assert (swerve["coverage"], swerve["field_blocking"]) == ("no", "monitor")
    json.dumps(found.as_dict(), allow_nan=False)


def test_danger_without_any_alert_blocks(loaded):
    text = ONE.replace("One", "Swerving One")
    small = Suite.load([parse_scenario(text, "x")], loaded)
    deaf = DecisionConfig(d_min_m=0.5, d_max_m=0.6, speed_adaptive=False)
    found = register.build_register(small, deaf)
    assert found.scenarios[0]["field_blocking"] == "yes"
    assert found.hazards[0]["field_blocking"] == "yes"
    assert found.hazards[0]["scenarios"] == ["Swerving One"]


def test_markdown_keeps_names_from_breaking_the_table(suite):
    lines = register.build_register(suite, DecisionConfig()).markdown().splitlines()
    row = next(line for line in lines if "Two" in line)
    assert "Two \\<b\\>\\&\\|" in row
    header = next(line for line in lines if line.startswith("| Scenario |"))
    assert row.replace("\\|", "").count("|") == header.count("|")


def test_the_audit_says_what_the_suite_says(tmp_path, suite, loaded):
    path = tmp_path / "audit.jsonl"
    write_audit(path, suite, WEAK, loaded, 5)
    records = [json.loads(line) for line in path.read_text().splitlines()]
    headers = [r for r in records if r["type"] == "header"]
    frames = [r for r in records if r["type"] == "frame"]
    assert [h["scenario"] for h in headers] == list(suite.names)
    assert {h["seed"] for h in headers} == {5}
    assert {h["suite_hash"] for h in headers} == {suite.hash}
    assert headers[0]["config_hash"] != loaded.hash  # WEAK is not what the file says
    states = suite.states(WEAK)
    assert [f["state"] for f in frames] == [State(int(s)).name for s in states]
    assert [f["danger"] for f in frames] == suite.truth_frames.danger.tolist()
    assert [f["actionable"] for f in frames] == suite.truth_frames.actionable.tolist()
    assert all((f["alert_tracks"] is not None) == (f["raw_state"] == "ALERT") for f in frames)
    for frame in frames[:: len(frames) // 7]:
        lane = suite.names.index(frame["scenario"])
        for agent in frame["agents"]:
            place = next(
                i for i, a in enumerate(suite.scenarios[lane].agents) if a.id == agent["id"]
            )
            seen = suite.perception_results[lane]
            assert agent["true"] == pytest.approx(seen.true_m[frame["frame"], place], abs=1e-4)
            off = np.hypot(*(np.subtract(agent["observed"], agent["true"])))
            assert agent["error_m"] == pytest.approx(off, abs=3e-4)
    assert list(tmp_path.iterdir()) == [path]


def test_the_audit_names_a_file_that_cannot_be_written(tmp_path, suite, loaded):
    with pytest.raises(BikepedError, match="audit"):
        write_audit(tmp_path / "no" / "a.jsonl", suite, WEAK, loaded)
