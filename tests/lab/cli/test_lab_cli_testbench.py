"""`bikeped testbench`: challenges give the page's numbers again; the report is written whole."""

import asyncio
import json
import shlex
import signal
import subprocess
import sys
import urllib.request

import msgspec
import pytest
from aiohttp.test_utils import TestClient, TestServer

from bikeped.cli.main import main
from bikeped.config.load import load_config
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.testbench.comparison import InvocationOptions
from bikeped.lab.testbench.pages import add_testbench
from bikeped.lab.testbench.settings import settings_in_force
from bikeped.web.security import AccessPolicy
from bikeped.web.server import make_application

OWN = """
name: My crossing
agents:
  - {id: 1, kind: pedestrian, path: [[0.0, 5.0, -8.0], [9.0, 5.0, 4.0]]}
  - {id: 2, kind: cyclist, path: [[0.5, -13.0, -2.0], [9.0, 32.0, -2.0]]}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three scenarios are enough, and quick."""
    folder = tmp_path_factory.mktemp("few")
    for name in ("swerving-cyclist", "u-turn-cyclist", "safe-crossing"):
        (folder / f"{name}.yaml").write_bytes((bundled_folder() / f"{name}.yaml").read_bytes())
    return folder


def page_says(folder, **changes):
    """The suite's answer to a page, and the bench that was asked."""

    async def ask():
        loaded, scenarios = load_config(), load_scenarios(folder)
        bench = msgspec.structs.replace(settings_in_force(loaded), **changes)
        access = AccessPolicy(frozenset({"127.0.0.1"}))
        app = make_application(
            access,
            lambda app: add_testbench(app, loaded, scenarios, InvocationOptions(None, folder)),
        )
        async with TestClient(TestServer(app)) as client:
            asked = {"bench": msgspec.to_builtins(bench)}
            answer = await client.post("/testbench/suite", json=asked)
            trials = await client.post("/testbench/trials", json=asked)
            return {**await answer.json(), **await trials.json()}

    return asyncio.run(ask())


def figures(data):
    """What must be the same: both sides without the words of the gates, and what changed."""
    sides = {key: {**data[key]} for key in ("before", "after")}
    for side in sides.values():
        side["gates"] = [
            {k: v for k, v in gate.items() if k not in ("rule", "shown")} for gate in side["gates"]
        ]
    return {**sides, "changed": data["changed"]}


def base():
    return settings_in_force(load_config())


def cases():
    replace = msgspec.structs.replace
    one = base()
    decision = replace(
        one.decision, d_max_m=9.1, memory_frames=30, speed_adaptive=False, rule="ttc"
    )
    return {
        "decision": ({"decision": decision}, True),
        "camera": ({"camera": replace(one.camera, height_m=5.5, pitch_deg=-20.0)}, True),
        "truth": ({"danger": replace(one.danger, cpa_radius_m=3.0, braking="ebike")}, True),
        "misses": (
            {"perception": replace(one.perception, recall="size", burst_frames=4.0, trials=2)},
            False,
        ),
        "latency": ({"delay": replace(one.delay, delay_ms=198.0, order=1)}, False),
        "own scenario": ({"scripts": (OWN,), "decision": decision}, False),
        "moved": ({"camera": replace(one.camera, x_m=0.0, heading_deg=80.0)}, False),
    }


@pytest.mark.parametrize("name", list(cases()))
def test_a_challenge_gives_the_page_s_numbers_on_the_command_line(name, folder, tmp_path, capsys):
    changes, plain = cases()[name]
    said = page_says(folder, **changes)
    assert said["changes"]
    file = tmp_path / "challenge.json"
    file.write_text(said["file"], encoding="utf-8")
    where = ["--scenarios", str(folder)]
    for again in (str(file), f"http://127.0.0.1:8090/testbench#{said['link']}"):
        assert main(["testbench", "contest", again, *where, "--json", "-"]) == 0
        data = json.loads(capsys.readouterr().out)
        assert figures(data) == figures(said)
        assert data["trials"] == said["trials"]
        repeat = shlex.split(data["command"])
        assert main([*repeat[1:], "--json", "-"]) == 0
        assert figures(json.loads(capsys.readouterr().out)) == figures(said)
    assert (said["command"] is not None) == plain
    if plain:  # the older command says the same challenge
        words = shlex.split(said["command"])
        assert words[0] == "bikeped"
        assert main([*words[1:], "--json", "-"]) == 0
        assert figures(json.loads(capsys.readouterr().out)) == figures(said)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["contest", "nowhere.json"], "nowhere.json"),
        (["contest", "decision.d_max_m=-3"], "d_max_m"),
        (["contest", "#decision.nothing=1"], "no such setting"),
        (["export", "nowhere/report.html"], "nowhere/report.html"),
        (["--port", "1", "export", "x.html"], "after the subcommand"),
    ],
)
def test_bad_input_is_one_line(words, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["testbench", *words]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_challenge_is_never_overwritten(folder, tmp_path, capsys):
    file = tmp_path / "challenge.json"
    file.write_text("{}")
    words = ["testbench", "contest", str(file), "--scenarios", str(folder), "--json", str(file)]
    assert main(words) == 2
    assert "overwritten" in capsys.readouterr().err
    assert file.read_text() == "{}"


def test_the_report_is_written_and_told(folder, tmp_path, capsys):
    out = tmp_path / "report.html"
    words = ["testbench", "export", str(out), "--scenarios", str(folder)]
    assert main([*words, "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["scenarios"] == 3
    assert out.stat().st_size == pytest.approx(told["size_mb"] * 1e6)
    assert "Swerving Cyclist" in out.read_text(encoding="utf-8")


def test_the_command_serves_until_it_is_told_to_end():
    words = [sys.executable, "-m", "bikeped.cli.main", "testbench", "--port", "0"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        address = next(word for word in line.split() if word.startswith("http"))
        with urllib.request.urlopen(address, timeout=30) as answer:
            assert "Pipeline in this frame" in answer.read().decode()
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)
    assert process.returncode == 0
