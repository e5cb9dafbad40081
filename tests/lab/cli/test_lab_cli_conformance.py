"""`bikeped conformance`: JSON as documented and alone on standard output, errors on one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from bikeped.cli.main import main
from bikeped.lab.scenarios.scenario import bundled_folder
from bikeped.lab.simulation.suite import CONFIGURATIONS

CONFIG = str(Path(__file__).parents[3] / "config.yaml")
FILES = ("swerving-cyclist.yaml", "safe-crossing.yaml")

SHARE = {"type": ["number", "null"], "minimum": 0, "maximum": 1}
METRICS = {
    "type": "object",
    "properties": {
        **dict.fromkeys(("sensitivity", "specificity", "sev_fn", "fatigue"), SHARE),
        "contact_sensitivity": SHARE,
        "mean_warning_budget_s": {"type": ["number", "null"], "minimum": 0},
        **{
            f"{a}_{b}": {"type": "integer", "minimum": 0}
            for a in ("true", "false")
            for b in ("positive", "negative")
        },
        "by_scenario": {
            "type": "object",
            "additionalProperties": {
                "type": "object",
                "required": ["min_warning_budget_s", "mean_warning_budget_s", "sensitivity"],
            },
        },
    },
    "required": [
        "sensitivity",
        "specificity",
        "sev_fn",
        "fatigue",
        "contact_sensitivity",
        "mean_warning_budget_s",
        "true_positive",
        "false_positive",
        "false_negative",
        "true_negative",
        "by_scenario",
    ],
}
COMPARE = {
    "type": "object",
    "properties": {
        "scenarios": {"const": len(FILES)},
        "camera": {"type": "object"},
        "config_hash": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
        "calibration_hash": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
        "seed": {"const": 0},
        "configurations": {
            "type": "object",
            "required": list(CONFIGURATIONS),
            "additionalProperties": METRICS,
        },
        "without_localisation_error": {
            "type": "object",
            "required": list(CONFIGURATIONS),
            "additionalProperties": METRICS,
        },
    },
    "required": [
        "scenarios",
        "camera",
        "config_hash",
        "calibration_hash",
        "seed",
        "configurations",
        "without_localisation_error",
    ],
}
LIST16 = {"type": "array", "minItems": 16, "maxItems": 16, "items": {"type": ["number", "null"]}}
LATENCY = {
    "type": "object",
    "properties": {
        "delay_ms": {"const": list(range(0, 500, 33))},
        **{
            name: {
                "type": "object",
                "additionalProperties": LIST16,
                "required": [
                    "sensitivity",
                    "specificity",
                    "sev_fn",
                    "fatigue",
                    "mean_warning_budget_s",
                    "contact_sensitivity",
                ],
            }
            for name in ("none", "first", "second")
        },
    },
    "required": ["delay_ms", "none", "first", "second"],
}
ERRORS = {
    "type": "object",
    "properties": {
        "table": {
            "type": "array",
            "minItems": 84,
            "maxItems": 84,
            "items": {
                "type": "object",
                "properties": {
                    "kind": {"enum": ["pedestrian", "cyclist", "car"]},
                    "distance_m": {"enum": [3, 5, 8, 10, 15, 20, 25]},
                    "bearing_deg": {"enum": [0, 30, 60, 80]},
                    "error_m": {"type": "number", "minimum": 0},
                },
                "required": ["kind", "distance_m", "bearing_deg", "error_m"],
            },
        }
    },
    "required": ["table"],
}


@pytest.fixture
def scenarios(tmp_path: Path) -> Path:
    folder = tmp_path / "scenarios"
    folder.mkdir()
    for name in FILES:
        shutil.copy(bundled_folder() / name, folder)
    return folder


def answer(
    capsys: pytest.CaptureFixture[str], scenarios: Path, *words: str, status: int = 0
) -> dict[str, Any]:
    """The JSON on standard output, where nothing else may be."""
    arguments = ["conformance", *words, "-c", CONFIG, "--scenarios", str(scenarios)]
    assert main([*arguments, "--json", "-"]) == status
    data: dict[str, Any] = json.loads(capsys.readouterr().out)
    return data


def test_compare(capsys: pytest.CaptureFixture[str], scenarios: Path) -> None:
    jsonschema.validate(answer(capsys, scenarios, "compare"), COMPARE)


def test_compare_takes_further_configurations(
    capsys: pytest.CaptureFixture[str], scenarios: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("decision: {d_max_m: 10, speed_adaptive: false}\n")
    found = answer(capsys, scenarios, "compare", "--configuration", f"mine={own}")
    assert list(found["configurations"]) == [*CONFIGURATIONS, "mine"]
    assert found["configurations"]["mine"] != found["configurations"]["selected"]


def test_latency(capsys: pytest.CaptureFixture[str], scenarios: Path) -> None:
    jsonschema.validate(answer(capsys, scenarios, "latency"), LATENCY)


def test_latency_with_loss(capsys: pytest.CaptureFixture[str], scenarios: Path) -> None:
    words = ("latency", "--loss", "--bursts", "--trials", "2", "--processes", "1", "--seed", "5")
    found = answer(capsys, scenarios, *words)
    assert (found["trials"], found["seed"], found["burst"]) == (2, 5, 5.0)
    assert set(found["predictors"]) == {"none", "first", "second"}


def test_errors(capsys: pytest.CaptureFixture[str], scenarios: Path) -> None:
    found = answer(capsys, scenarios, "errors")
    jsonschema.validate(found, ERRORS)
    row = found["table"][0]
    assert (row["kind"], row["distance_m"], row["bearing_deg"]) == ("pedestrian", 3, 0)
    assert row["error_m"] == pytest.approx(0.248, abs=0.001)


def test_set_changes_the_configuration(capsys: pytest.CaptureFixture[str], scenarios: Path) -> None:
    usual = answer(capsys, scenarios, "run", "--scenario", "Swerving Cyclist")
    other = answer(
        capsys, scenarios, "run", "--scenario", "Swerving Cyclist", "--set", "decision.d_max_m=5"
    )
    assert usual["scenarios"][0]["scenario"] == "Swerving Cyclist"
    assert other["decision"]["d_max_m"] == 5
    assert other["config_hash"] != usual["config_hash"]


def test_truth(capsys: pytest.CaptureFixture[str], scenarios: Path) -> None:
    found = answer(capsys, scenarios, "truth")
    assert len(found["rows"]) == 10
    assert len(found["braking"]["rows"]) == 4


def test_montecarlo(capsys: pytest.CaptureFixture[str], scenarios: Path, tmp_path: Path) -> None:
    curve = tmp_path / "curve.csv"
    curve.write_text("area,recall\n0,0.2\n9000,0.9\n")
    words = ("montecarlo", "--trials", "2", "--processes", "1", "--recall-curve", str(curve))
    found = answer(capsys, scenarios, *words, "--set", "decision.d_max_m=9")
    rows = {(r["loss"], r["recall"], r["configuration"]) for r in found["rows"]}
    names = ["configured", *CONFIGURATIONS]
    assert rows == {
        (loss, recall, name)
        for loss in ("independent", "burst")
        for recall in ("flat", "size", "curve")
        for name in names
    }
    part = found["rows"][0]["metrics"]["sensitivity"]
    assert part["low"] <= part["mean"] <= part["high"]


def test_optimize_writes_a_candidate(
    capsys: pytest.CaptureFixture[str], scenarios: Path, tmp_path: Path
) -> None:
    out = tmp_path / "candidate.yaml"
    words = ("optimize", "--maxiter", "1", "--popsize", "2", "--out", str(out))
    found = answer(capsys, scenarios, *words)
    assert found["seed"] == 42
    assert found["evaluations"] == 20
    assert yaml.safe_load(out.read_text())["decision"] == found["decision"]
    measured = answer(capsys, scenarios, "compare", "--configuration", f"found={out}")
    again = measured["configurations"]["found"]
    assert {key: again[key] for key in found["metrics"]} == found["metrics"]


def test_deployment(capsys: pytest.CaptureFixture[str], scenarios: Path) -> None:
    found = answer(capsys, scenarios, "deployment", "--trials", "2")
    assert len(found["rows"]) == 16


def test_tables_for_people(capsys: pytest.CaptureFixture[str], scenarios: Path) -> None:
    arguments = ["-c", CONFIG, "--scenarios", str(scenarios)]
    assert main(["conformance", "compare", *arguments]) == 0
    said = capsys.readouterr().out
    assert "sens, %" in said
    assert "naive_closing" in said
    assert main(["conformance", "run", *arguments]) == 0
    assert "Swerving Cyclist" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name: X\nagents: 3\n", ["agents"]),
        (
            "name: X\nagents:\n  - {id: 7, kind: cyclist, path: [[1, 0, 0], [0, 1, 1]]}\n",
            ["agent 7", "sort the waypoints"],
        ),
        ("name: [\n", ["YAML"]),
    ],
)
def test_a_bad_scenario_file_is_one_line(
    capsys: pytest.CaptureFixture[str], scenarios: Path, text: str, words: list[str]
) -> None:
    (scenarios / "bad.yaml").write_text(text)
    for name in ("run", "montecarlo", "reproduce"):
        status = main(["conformance", name, "-c", CONFIG, "--scenarios", str(scenarios)])
        assert status == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert len(printed.err.splitlines()) == 1
        for word in ("bad.yaml", *words):
            assert word in printed.err


@pytest.mark.parametrize(
    "words",
    [
        ["run", "--scenario", "Swerving Ciclist"],
        ["run", "--scenarios", "/nowhere"],
        ["run", "--set", "decision.d_maxx=3"],
        ["run", "--json", "/nowhere/at/all.json"],
        ["compare", "--configuration", "mine"],
        ["compare", "--configuration", "selected=a.yaml"],
        ["compare", "--configuration", "mine=/nowhere.yaml"],
        ["montecarlo", "--trials", "0"],
        ["montecarlo", "--recall-curve", "/nowhere.csv"],
        ["latency", "--bursts"],
        ["optimize", "--out", "/nowhere/at/all.yaml"],
        ["nothing"],
    ],
)
def test_bad_input_is_one_line_and_two(
    capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    assert main(["conformance", *words, "-c", CONFIG]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 1


def test_group_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["conformance", "--help"]) == 0
    said = capsys.readouterr().out
    experiments = ["run", "compare", "montecarlo", "latency", "truth", "optimize", "deployment"]
    experiments += ["placement", "errors", "reproduce"]
    for name in [*experiments, "gate", "promote", "contest", "register", "plot", "encounters"]:
        assert f"  {name} " in said


def test_run_writes_the_audit_of_every_frame(tmp_path, capsys):
    target = tmp_path / "audit.jsonl"
    assert (
        main(["conformance", "run", "--scenario", "Swerving Cyclist", "--audit", str(target)]) == 0
    )
    header, *frames = [json.loads(line) for line in target.read_text().splitlines()]
    assert header["scenario"] == "Swerving Cyclist"
    assert header["frames"] == len(frames)
    assert {"ALERT", "WARNING"} <= {frame["state"] for frame in frames}
    assert main(["conformance", "run", "--audit", str(tmp_path / "no" / "a.jsonl")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
