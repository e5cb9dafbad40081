"""Gates and promotion: what fails writes nothing, what passes changes one section only."""

import json
import math
import os
import stat

import click
import pytest

from bikeped.config.load import load_config, parse_decision
from bikeped.config.provenance import check_provenance, decision_hash
from bikeped.config.schema import DecisionConfig
from bikeped.errors import BikepedError, ConfigError
from bikeped.lab.cli.conformance import command as conformance
from bikeped.lab.governance import gates as promoting
from bikeped.lab.governance.gates import all_hold, check_gate_figures, check_gates
from bikeped.lab.scenarios.scenario import load_scenarios
from bikeped.lab.simulation.suite import Suite

SCENARIO = """
name: Straight On
hazard: standard
expected: alert
agents:
  - {id: 1, kind: pedestrian, path: [[0.0, 5.0, -8.0], [9.0, 5.0, 4.0]]}
  - {id: 2, kind: cyclist, path: [[0.5, -13.0, -2.0], [9.0, 32.0, -2.0]]}
"""
CONFIG = """\
# A city's own remark on top.
camera:
  radius_px: 1750   # measured by the installer
  fov_deg: 197.90
  height_m: 3.6576

decision:           # hand-made
  memory_frames: 50 # N
  d_max_m: 20.0
  # a remark of the section

# A remark on the light.
feedback:
  light: simulated  # no lamp yet
"""


def run(*arguments):
    """Exit status of a governance command."""
    try:
        return conformance.main(args=[str(a) for a in arguments], standalone_mode=False) or 0
    except BikepedError as error:
        return error.exit_status


@pytest.fixture
def place(tmp_path):
    (tmp_path / "suite").mkdir()
    (tmp_path / "suite" / "one.yaml").write_text(SCENARIO)
    (tmp_path / "config.yaml").write_text(CONFIG)
    (tmp_path / "good.yaml").write_text("decision:\n  memory_frames: 58\n  d_max_m: 24.8\n")
    (tmp_path / "bad.yaml").write_text("decision:\n  d_max_m: 3.0\n  speed_adaptive: false\n")
    return tmp_path


def options(place):
    return ["-c", place / "config.yaml", "--scenarios", place / "suite"]


def contents(place):
    return {p.name: p.read_bytes() for p in place.iterdir() if p.is_file()}


def test_a_failing_candidate_is_refused_and_nothing_is_written(place, capsys):
    before = contents(place)
    assert run("promote", place / "bad.yaml", *options(place)) == 1
    assert contents(place) == before
    out = capsys.readouterr().out
    assert "Refused" in out
    assert "sensitivity" in out


def test_promotion_replaces_the_section_and_keeps_everything_else(place):
    assert run("promote", place / "good.yaml", *options(place)) == 0
    text = (place / "config.yaml").read_text()
    head, tail = CONFIG.split("decision:")[0], CONFIG[CONFIG.index("\n# A remark on the light") :]
    assert text.startswith(head)
    assert text.endswith(tail + "complete: true\n")
    assert "hand-made" not in text
    assert "a remark of the section" not in text
    assert (place / "config.yaml.bak").read_text() == CONFIG
    loaded = load_config(place / "config.yaml")
    assert loaded.config.decision == DecisionConfig()
    assert check_provenance(loaded).holds


def test_provenance_names_what_the_promotion_rests_on(place):
    (place / "trace.csv").write_text("1,2\n")
    assert run("promote", place / "good.yaml", *options(place), "--trace", place / "trace.csv") == 0
    record = json.loads((place / "config.provenance.json").read_text())
    loaded = load_config(place / "config.yaml")
    suite = Suite.load(load_scenarios(place / "suite"), loaded)
    assert record["suite_hash"] == suite.hash
    assert record["config_hash"] == loaded.hash
    assert record["decision_hash"] == decision_hash(loaded.config.decision)
    assert record["metrics"] == suite.measure(loaded.config.decision).as_dict()
    assert set(record["files"]) == {"candidate", "trace"}
    assert all(gate["holds"] for gate in record["gates"])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("  d_max_m: 24.8", "  d_max_m: 23.0"), "differs from the promoted"),
        (("  height_m: 3.6576", "  height_m: 4.2"), "the camera or its calibration"),
        (("  height_m: 3.6576", "  height_m: 3.6576\n  crop_size: 3499"), "the camera or"),
        (("  height_m: 3.6576", "  height_m: 3.6576\n  table_step_px: 9"), "the camera or"),
        (
            ("feedback:", "tracking:\n  acceleration_cyclist_mps2: 4.5\nfeedback:"),
            "the tracking section",
        ),
        (("feedback:", "latency:\n  compensation: measured\nfeedback:"), "the latency section"),
        (("feedback:", "detection:\n  cyclist: [rider]\nfeedback:"), "the detector"),
        (("feedback:", "detection:\n  model: bundled\nfeedback:"), "the detector"),
        (("feedback:", f"detection:\n  sha256: {'a' * 64}\nfeedback:"), "the detector"),
    ],
)
def test_a_change_after_the_promotion_is_noticed(place, change, said):
    assert run("promote", place / "good.yaml", *options(place)) == 0
    path = place / "config.yaml"
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    found = check_provenance(load_config(path))
    assert not found.holds
    assert said in found.text
    assert "promote" in found.text


@pytest.mark.parametrize(
    "change",
    [
        ("feedback:", "detection:\n  providers: [cpu]\nfeedback:"),
        ("feedback:", "mqtt:\n  site: elsewhere\nfeedback:"),
        ("  height_m: 3.6576", "  height_m: 3.6576\n  source: /dev/video7\n  fps: 25"),
        ("# A city's own remark on top.", "# Another remark."),
    ],
)
def test_what_decides_nothing_may_change_after_the_promotion(place, change):
    assert run("promote", place / "good.yaml", *options(place)) == 0
    path = place / "config.yaml"
    path.write_text(path.read_text().replace(*change))
    assert check_provenance(load_config(path)).holds


def test_the_model_file_and_the_lens_file_count_by_their_content(place):
    (place / "net.onnx").write_bytes(b"one")
    lens = {"model": "equidistant", "cx": 1750, "cy": 1750, "focal_length": 1013, "fov_deg": 197.9}
    (place / "lens.json").write_text(json.dumps(lens))
    path = place / "config.yaml"
    more = "  calibration: lens.json\n\ndetection:\n  model: net.onnx\n"
    path.write_text(CONFIG.replace("  height_m: 3.6576\n", "  height_m: 3.6576\n" + more))
    assert run("promote", place / "good.yaml", *options(place)) == 0
    assert check_provenance(load_config(path)).holds
    (place / "net.onnx").write_bytes(b"two")
    assert "but the detector changed" in check_provenance(load_config(path)).text
    (place / "net.onnx").write_bytes(b"one")
    (place / "lens.json").write_text(json.dumps({**lens, "focal_length": 1014}))
    assert "but the camera or its calibration changed" in check_provenance(load_config(path)).text


@pytest.mark.parametrize("missing", ["tracking_hash", "latency_hash", "detector_hash"])
def test_an_older_provenance_is_answered_with_promote_again(place, missing):
    assert run("promote", place / "good.yaml", *options(place)) == 0
    file = place / "config.provenance.json"
    record = json.loads(file.read_text())
    del record[missing]
    file.write_text(json.dumps(record))
    found = check_provenance(load_config(place / "config.yaml"))
    assert not found.holds
    assert found.text.endswith("did not record tracking, latency and detector: promote again")
    assert "\n" not in found.text


def test_an_override_at_start_is_noticed(place):
    assert run("promote", place / "good.yaml", *options(place)) == 0
    found = check_provenance(load_config(place / "config.yaml", ["decision.d_min_m=1.0"]))
    assert not found.holds
    assert "differs" in found.text


def test_other_code_is_noticed(place, monkeypatch):
    assert run("promote", place / "good.yaml", *options(place)) == 0
    monkeypatch.setattr("bikeped.config.provenance.code_hash", lambda: "0" * 64)
    assert "code" in check_provenance(load_config(place / "config.yaml")).text


@pytest.mark.parametrize("content", [None, b"", b"{", b"[]", b'{"decision_hash": 3}', b"\xff"])
def test_absent_and_broken_provenance_end_in_one_line(place, content):
    if content is not None:
        (place / "config.provenance.json").write_bytes(content)
    found = check_provenance(load_config(place / "config.yaml"))
    assert not found.holds
    assert "\n" not in found.text
    assert "provenance" in found.text


def test_an_interruption_leaves_a_whole_configuration(place, monkeypatch):
    real = promoting.write_like

    def stop_at_config(path, content, like):
        if path.name == "config.yaml":
            raise KeyboardInterrupt
        real(path, content, like)

    monkeypatch.setattr(promoting, "write_like", stop_at_config)
    with pytest.raises(click.exceptions.Abort):
        run("promote", place / "good.yaml", *options(place))
    assert (place / "config.yaml").read_text() == CONFIG
    assert not check_provenance(load_config(place / "config.yaml")).holds


def test_a_full_disk_leaves_the_configuration_and_no_scraps(place, monkeypatch):
    def no_room(handle):
        raise OSError(28, "No space left on device")

    before = contents(place)
    monkeypatch.setattr(os, "fsync", no_room)
    assert run("promote", place / "good.yaml", *options(place)) == 2
    assert contents(place) == before


def test_mode_and_link_of_the_configuration_stay(place):
    path = place / "config.yaml"
    path.chmod(0o640)
    (place / "etc").mkdir()
    link = place / "etc" / "config.yaml"
    link.symlink_to(path)
    arguments = ["-c", link, "--scenarios", place / "suite"]
    assert run("promote", place / "good.yaml", *arguments) == 0
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert "promoted" in path.read_text()


def test_a_configuration_in_braces_is_refused(place):
    (place / "config.yaml").write_text(
        "{camera: {radius_px: 1750, fov_deg: 197.9}, decision: {d_max_m: 20}}\n"
    )
    before = contents(place)
    assert run("promote", place / "good.yaml", *options(place)) == 2
    assert contents(place) == before


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("camera:\n  height_m: 3\n", "decision"),
        ("decision:\n  d_maxm: 3\n", "d_max_m"),
        ("decision:\n  d_max_m: far\n", "d_max_m"),
        ("decision:\n  d_min_m: 9\n  d_max_m: 8\n", "exchange"),
        ("decision: [\n", "YAML"),
        ("decision:\n  d_max_m: 20\nlight: 3\n", "light"),
    ],
)
def test_a_bad_candidate_is_named(place, text, said):
    with pytest.raises(ConfigError, match=said):
        parse_decision(text, "candidate.yaml")
    (place / "odd.yaml").write_text(text)
    assert run("gate", place / "odd.yaml", *options(place)) == 2
    assert run("gate", place / "absent.yaml", *options(place)) == 2


def test_gate_ends_with_0_and_1_and_takes_overrides_of_the_candidate(place):
    assert run("gate", place / "good.yaml", *options(place)) == 0
    assert run("gate", place / "bad.yaml", *options(place)) == 1
    worse = ["--set", "decision.d_max_m=3", "--set", "decision.speed_adaptive=false"]
    assert run("gate", place / "good.yaml", *options(place), *worse) == 1


def test_promote_refuses_overrides_of_the_camera(place):
    before = contents(place)
    arguments = [*options(place), "--set", "camera.height_m=6"]
    assert run("promote", place / "good.yaml", *arguments) == 2
    assert contents(place) == before


def figures(sensitivity=0.95, specificity=0.95, mean_warning_budget_s=3.0):
    return {
        "sensitivity": sensitivity,
        "specificity": specificity,
        "mean_warning_budget_s": mean_warning_budget_s,
    }


@pytest.mark.parametrize(
    ("values", "holds"),
    [
        ({}, True),
        ({"sensitivity": 0.9}, True),
        ({"sensitivity": 0.8999}, False),
        ({"specificity": 0.9}, True),
        ({"specificity": 0.8999}, False),
        ({"mean_warning_budget_s": 1.87}, False),
        ({"mean_warning_budget_s": 1.8701}, True),
        ({"sensitivity": None}, False),
        ({"mean_warning_budget_s": None}, False),
    ],
)
def test_gates_at_their_bounds(values, holds):
    assert all_hold(check_gate_figures(figures(**values))) is holds


def test_a_failing_figure_never_reads_like_a_passing_one():
    gate = check_gate_figures(figures(sensitivity=0.89996))[0]
    assert not gate.holds
    assert float(gate.format_value(gate.measured).split()[0]) < 90.0
    assert check_gate_figures(figures(sensitivity=0.9347))[0].format_value(0.9347) == "93.5 %"
    assert "nothing" in gate.format_value(math.nan)


def test_gates_of_metrics_are_those_of_their_json(place):
    loaded = load_config(place / "config.yaml")
    metrics = Suite.load(load_scenarios(place / "suite"), loaded).measure(DecisionConfig())
    assert check_gates(metrics) == check_gate_figures(metrics.as_dict())
