"""All of it in one folder: resumed, reused only when nothing changed, the same in two processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bikeped.config.load import load_config
from bikeped.errors import BikepedError
from bikeped.lab.experiments import reproduce as rep
from bikeped.lab.result_tables import ExperimentResult
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.simulation.suite import Suite

CONFIG = Path(__file__).parents[3] / "config.yaml"
LOADED = load_config(CONFIG)
SMALL = rep.ReproduceSettings(
    trials=2, maxiter=1, popsize=2, deployment_trials=2, placement_trials=2
)


@pytest.fixture(scope="module")
def suite() -> Suite:
    scenarios = load_scenarios(bundled_folder())
    return Suite.load(
        [s for s in scenarios if s.name in ("Swerving Cyclist", "U-Turn Cyclist")], LOADED
    )


@pytest.fixture(autouse=True)
def _quick_placement(monkeypatch: pytest.MonkeyPatch) -> None:
    """130 cells are not what is tested here."""
    monkeypatch.setattr(rep.deployment, "HEIGHTS_M", (1.5, 5.5))


def contents(folder: Path) -> dict[str, Any]:
    found = {}
    for file in sorted((folder / "data").glob("*.json")):
        document = json.loads(file.read_text())
        found[file.name] = (document["data"], document["tables"])
    return found


def test_everything_is_there_and_reused(suite: Suite, tmp_path: Path) -> None:
    counts: list[int] = []
    first = rep.reproduce(suite, LOADED, tmp_path, SMALL, figures=False, progress=counts.append)
    assert counts == list(range(len(rep.EXPERIMENTS) + 2))
    assert first.reused == ()
    assert set(rep.REPORT_ORDER) == set(rep.EXPERIMENTS) == set(first.seconds)
    assert [r.name for r in first.results] == list(rep.REPORT_ORDER)
    for result in first.results:
        for table in result.tables:
            lines = (tmp_path / "tables" / f"{table.name}.csv").read_text().splitlines()
            assert len(lines) == len(table.rows) + 1
            stored = json.loads((tmp_path / "tables" / f"{table.name}.json").read_text())
            assert stored["columns"] == list(table.columns)
    before = contents(tmp_path)
    second = rep.reproduce(suite, LOADED, tmp_path, SMALL, figures=False)
    assert set(second.reused) == set(rep.EXPERIMENTS)
    # What is read back is what was computed, to the last bit.
    assert [(r.name, r.data) for r in second.results] == [(r.name, r.data) for r in first.results]
    assert [[list(t.rows) for t in r.tables] for r in second.results] == [
        [list(t.rows) for t in r.tables] for r in first.results
    ]
    (tmp_path / "data" / "truth.json").write_text('{"key": "cut o')
    third = rep.reproduce(suite, LOADED, tmp_path, SMALL, figures=False)
    assert set(third.seconds) == {"truth"}
    assert contents(tmp_path) == before
    fourth = rep.reproduce(suite, LOADED, tmp_path, replace(SMALL, seed=1), figures=False)
    assert fourth.reused == ()


def test_two_processes_give_the_same(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Fresh processes do not see the patch of the placement grid.
    few = {n: f for n, f in rep.EXPERIMENTS.items() if n not in ("placement", "deployment")}
    monkeypatch.setattr(rep, "EXPERIMENTS", few)
    monkeypatch.setattr(rep, "REPORT_ORDER", tuple(few))
    rep.reproduce(suite, LOADED, tmp_path / "one", SMALL, figures=False)
    rep.reproduce(suite, LOADED, tmp_path / "two", SMALL, processes=2, figures=False)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_resumes_after_an_interruption(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> ExperimentResult:
        raise KeyboardInterrupt

    whole = dict(rep.EXPERIMENTS)
    names = list(whole)
    monkeypatch.setitem(rep.EXPERIMENTS, names[4], interrupted)
    with pytest.raises(KeyboardInterrupt):
        rep.reproduce(suite, LOADED, tmp_path, SMALL, figures=False)
    assert {p.stem for p in (tmp_path / "data").iterdir()} == set(names[:4])
    monkeypatch.setitem(rep.EXPERIMENTS, names[4], whole[names[4]])
    found = rep.reproduce(suite, LOADED, tmp_path, SMALL, figures=False)
    assert set(found.reused) == set(names[:4])
    assert len(found.results) == len(names)


def test_interrupted_from_the_terminal_it_ends_at_once(tmp_path: Path) -> None:
    """As Ctrl-C does it: the signal goes to the whole group, workers included."""
    command = [sys.executable, "-m", "bikeped.cli.main", "conformance", "reproduce", "--no-figures"]
    command += ["-c", str(CONFIG), "--out", str(tmp_path), "--processes", "2", "--trials", "2000"]
    with subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE) as process:
        data = tmp_path / "data"
        while not data.is_dir():
            time.sleep(0.05)
            assert process.poll() is None
        time.sleep(1.5)  # the workers are starting, or have long jobs: at any moment it must end
        os.killpg(process.pid, signal.SIGINT)
        begin = time.monotonic()
        _, said = process.communicate(timeout=60)
    assert time.monotonic() - begin < 30
    assert process.returncode == 130
    assert said.decode().split() == ["bikeped:", "interrupted"]
    for file in data.iterdir():
        json.loads(file.read_text())


def test_key_covers_what_a_result_depends_on(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    key = rep.cache_key("run", suite, LOADED, SMALL)
    assert rep.cache_key("run", suite, LOADED, SMALL) == key
    other_config = load_config(CONFIG, ["decision.d_max_m=20"])
    turned = replace(suite, scenarios=suite.scenarios[::-1])
    others = [
        rep.cache_key("truth", suite, LOADED, SMALL),
        rep.cache_key("run", suite, other_config, SMALL),
        rep.cache_key("run", turned, LOADED, SMALL),
        rep.cache_key("run", replace(suite, scenarios=suite.scenarios[:1]), LOADED, SMALL),
        rep.cache_key("run", suite, LOADED, replace(SMALL, burst=3.0)),
        rep.cache_key("run", suite, LOADED, replace(SMALL, curve=((0.0, 1.0), (0.5, 1.0)))),
    ]
    monkeypatch.setattr(rep, "code_version", lambda: "another")
    others.append(rep.cache_key("run", suite, LOADED, SMALL))
    assert len({key, *others}) == len(others) + 1


def test_a_folder_that_cannot_be(suite: Suite, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BikepedError, match="--out"):
        rep.reproduce(suite, LOADED, tmp_path / "file", SMALL, figures=False)
