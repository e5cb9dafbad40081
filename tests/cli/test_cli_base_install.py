"""Every command on an installation without extras: it works, or names what to install."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import click
import pytest
from coco_sets import annotation, write_set

from bikeped.cli.main import cli
from bikeped.errors import EXTRAS, MissingPackageError, require
from bikeped.lab.scenarios.scenario import bundled_folder

#: Reads command lines from standard input and writes [status, stdout, stderr] for each. Packages
#: of extras cannot be found: neither by an import nor by find_spec.
RUNNER = """
import contextlib, io, json, sys, traceback

class Without:
    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in HIDDEN:
            return None
        return self.finder.find_spec(name, path, target)

HIDDEN = set(sys.argv[1].split(","))
sys.meta_path[:] = [Without(f) for f in sys.meta_path if hasattr(f, "find_spec")]
from bikeped.cli.main import main

answers = []
for words in json.load(sys.stdin):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(words)
        except BaseException:
            status = traceback.format_exc()
    answers.append([status, out.getvalue(), err.getvalue()])
json.dump(answers, sys.stdout)
"""

#: Arguments that keep a command short; `{...}` is a file of the test.
ARGUMENTS = {
    "config check": "-c {config}",
    "replay": "{clip} -c {config}",
    "demo": "--seconds 0.1 --out {out}/demo",
    "doctor": "-c {config} --no-light --no-sound",
    "align": "{clip} -c {config} --grid {out}/grid.png",
    "calibrate": "{data}/images --pattern 8x6",
    **dict.fromkeys(
        [f"conformance {name}" for name in ("compare", "errors", "latency", "run", "truth")],
        "--scenarios {few}",
    ),
    "conformance deployment": "--scenarios {few} --trials 1",
    "conformance placement": "--scenarios {few} --trials 1",
    "conformance montecarlo": "--scenarios {few} --trials 2 --processes 1",
    "conformance optimize": "--scenarios {few} --maxiter 1 --popsize 2",
    "conformance gate": "{config} -c {config} --scenarios {few}",
    "conformance promote": "{config} -c {config} --scenarios {few}",
    "conformance contest": "-c {config} --scenarios {few} --truth cpa_radius_m=3",
    "conformance pixels": "--scenario nothing --processes 1",
    "conformance plot": "--out {out}/plots --scenarios {few}",
    "conformance register": "--scenarios {few} --out {out}/register.md",
    "conformance reproduce": "--scenarios {few} --out {out}/all --trials 1 --processes 1",
    "testbench": "--host 203.0.113.7",
    "testbench contest": "#rule=naive --scenarios {few}",
    "testbench export": "{out}/report.html --scenarios {few}",
    "scene": "safe-crossing --still 0 {out}/still.png --size 160x90",
    "model augment": "{data} --out {out}/fisheye --size 64 --processes 1",
    "model train": "{data} --out {out}/trained --steps 1",
    "model export": "{out}/weights.pt",
    "model evaluate": "{model} {data}",
}


def leaves(command: click.Command, path: tuple[str, ...] = ()) -> list[str]:
    """Every command that does something, as it is typed."""
    if not isinstance(command, click.Group):
        return [" ".join(path)]
    context = click.Context(command)
    found = [" ".join(path)] if command.invoke_without_command else []
    for name in command.list_commands(context):
        child = command.get_command(context, name)
        assert child is not None
        found += leaves(child, (*path, name))
    return found


@pytest.fixture
def answers(tmp_path, small_config, make_clip, small_model):
    """What every command answers without any extra: {command: (status, stdout, stderr)}."""
    few = tmp_path / "few"
    few.mkdir()
    shutil.copy(bundled_folder() / "safe-crossing.yaml", few)
    (tmp_path / "out").mkdir()
    notes = [annotation(1, 1, 1, [60, 80, 90, 70])]
    places = {
        "clip": make_clip("clip.avi", 2),
        "config": small_config(more="decision: {d_max_m: 20}\n"),
        "data": write_set(tmp_path / "data", notes),
        "few": few,
        "model": small_model,
        "out": tmp_path / "out",
    }
    commands = leaves(cli)
    lines = [
        [*name.split(), *(word.format(**places) for word in ARGUMENTS.get(name, "").split())]
        for name in commands
    ]
    done = subprocess.run(
        [sys.executable, "-c", RUNNER, ",".join(EXTRAS)],
        input=json.dumps(lines),
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=110,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return dict(zip(commands, json.loads(done.stdout), strict=True))


@pytest.mark.slow
def test_every_command_answers_without_the_extras(answers):
    missing = {}
    for name, (status, _, err) in answers.items():
        assert status in (0, 1, 2), f"{name}: {status}"
        assert "Traceback" not in err, name
        if status == 2:
            assert err.splitlines()[-1].startswith("bikeped: "), f"{name}: {err}"
            assert err.count("bikeped: ") == 1, f"{name}: {err}"
        if "is not installed" in err:
            missing[name] = err.removeprefix("bikeped: ").strip()
    assert missing["model train"] == "torch is not installed; pip install 'bikeped[train]'"
    assert missing["calibrate"] == "scipy is not installed; pip install 'bikeped[calibrate]'"
    assert missing["conformance optimize"] == "scipy is not installed; pip install 'bikeped[sim]'"
    assert "matplotlib" in missing["conformance plot"]
    assert "pycocotools" in missing["model evaluate"]
    for name in ("config check", "replay", "demo", "align", "scene", "conformance run"):
        assert answers[name][0] == 0, f"{name}: {answers[name][2]}"
    for name in ("run", "doctor", "config show", "config schema"):
        assert name not in missing, missing[name]


def test_help_pages_need_no_extra_and_import_no_command():
    code = (
        "import sys\nfrom bikeped.cli.main import main\n"
        "assert main(['--help']) == 0\nassert main(['model', '--help']) == 0\n"
        "print([m for m in sys.modules if m.startswith(('numpy', 'rich', 'bikeped.pipeline'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_require_names_the_package_and_its_extra(monkeypatch):
    require("click")
    monkeypatch.setitem(sys.modules, "scipy", None)
    with pytest.raises(MissingPackageError, match=r"^scipy is not installed; pip .*\[sim\]'$"):
        require("click", "scipy")
    with pytest.raises(MissingPackageError, match=r"bikeped\[calibrate\]"):
        require("scipy", extra="calibrate")
