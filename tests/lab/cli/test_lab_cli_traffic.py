"""`bikeped conformance encounters` and `traffic`: the same files for the same seed, the JSON."""

import json
from pathlib import Path

import pytest
from traffic_scenes import write_traffic

from bikeped.cli.main import main
from bikeped.lab.scenarios.scenario import load_scenarios
from bikeped.lab.simulation.suite import CONFIGURATIONS

CONFIG = str(Path(__file__).parents[3] / "config.yaml")


def encounters(out, seed, count):
    arguments = ["--seed", str(seed), "--count", str(count), "--out", str(out)]
    return main(["conformance", "encounters", *arguments])


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_same_seed_same_bytes(tmp_path):
    assert encounters(tmp_path / "a", 7, 5) == 0
    assert encounters(tmp_path / "b", 7, 4) == 0
    assert encounters(tmp_path / "c", 8, 4) == 0
    a, b, c = (contents(tmp_path / name) for name in "abc")
    assert len(load_scenarios(tmp_path / "a")) == len(a) == 5
    assert b.items() <= a.items()  # a shorter list is the beginning of a longer one
    assert not set(b.values()) & set(c.values())


def test_a_folder_with_files_is_refused(tmp_path, capsys):
    (tmp_path / "mine.yaml").write_text("name: Mine")
    assert encounters(tmp_path, 0, 1) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "--out" in said
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


FIGURES = {
    *("alerts_per_hour", "red_share", "alerts_with_danger", "alerts_with_real_conflict"),
    *("episodes_under_500ms", "changes_per_minute", "red_off_red_per_hour"),
    *("alerts_per_hour_both_in_view", "changes_per_minute_both_in_view"),
    *("real_conflicts", "missed", "late", "fair_conflicts", "fair_missed", "fair_late"),
    *("sensitivity", "specificity", "specificity_shown", "specificity_strict"),
    *("contact_sensitivity", "sev_fn"),
}


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return write_traffic(tmp_path_factory.mktemp("street"))


def test_traffic_gives_the_documented_json(street, capsys):
    assert main(["conformance", "traffic", str(street), "-c", CONFIG, "--json", "-"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["scenes"] == 2
    assert data["tracker"] == "deployed"
    assert data["noise"] == "realistic"
    assert data["shown"] == {"on": 2, "window": 3, "hold_s": 1.5}
    assert set(data["rules"]) == {*CONFIGURATIONS, "foresight"}
    for figures in data["rules"].values():
        assert set(figures) >= FIGURES
        assert set(figures["by_scene"]) == {"safe-crossing", "swerving-cyclist"}
        assert all(set(scene) >= FIGURES for scene in figures["by_scene"].values())
    foresight, ttc = data["rules"]["foresight"], data["rules"]["ttc"]
    assert foresight["alerts_with_danger"] == 1
    assert foresight["to_foresight"]["red_share"] == 1
    assert ttc["by_scene"]["safe-crossing"]["alerts_per_hour"] == 0


def test_traffic_prints_chosen_rules(street, capsys):
    words = ["--rule", "ttc", "--rule", "configured", "--rule", "foresight", "--noise", "none"]
    words += ["--set", "decision.alert_hold_s=0.5"]
    assert main(["conformance", "traffic", str(street), "-c", CONFIG, *words]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("ttc", "configured", "foresight", "swerving-cyclist"))
    assert "narrow" not in said


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--rule", "ttcc"], "did you mean ttc?"),
        (["--noise", "loud"], "--noise"),
        (["--json", "poles.json"], "would overwrite"),
    ],
)
def test_traffic_refuses_in_one_line(street, capsys, monkeypatch, words, says):
    monkeypatch.chdir(street)
    before = contents(street)
    assert main(["conformance", "traffic", ".", "-c", CONFIG, *words]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert says in said
    assert contents(street) == before
