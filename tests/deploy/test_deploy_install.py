"""deploy/: the installer on a prefix with a fake Python, the unit file and the udev rules."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
INSTALL = ROOT / "deploy" / "install.sh"
UNIT = ROOT / "deploy" / "bikeped.service"
LAMP_UNIT = ROOT / "deploy" / "bikeped-lamp.service"
RULES = ROOT / "deploy" / "99-bikeped.rules"

# Stands for python3: makes a "virtual environment" whose programs note how they were called.
PYTHON = """#!/bin/sh
echo "python $*" >> "{log}"
case "$1 $2" in
  "-c import"*) exit {version_ok} ;;
  "-m venv")
    for last; do :; done
    mkdir -p "$last/bin"
    cp "{program}" "$last/bin/python"
    cp "{program}" "$last/bin/bikeped" ;;
esac
"""
PROGRAM = """#!/bin/sh
echo "$(basename "$0") $*" >> "{log}"
case "$*" in
  *"pip install"*) exit "$(cat "{folder}/pip")" ;;
  "config check"*) exit "$(cat "{folder}/check")" ;;
  "doctor"*) exit "$(cat "{folder}/doctor")" ;;
esac
"""


class Bench:
    """A fake Python, a prefix, and the installer between them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.prefix = folder / "root"
        self.log = folder / "log"
        self.log.touch()
        self.python = folder / "python3"
        program = folder / "program"
        program.write_text(PROGRAM.format(log=self.log, folder=folder))
        self.python.write_text(PYTHON.format(log=self.log, program=program, version_ok=0))
        for path in (program, self.python):
            path.chmod(0o755)
        for name in ("pip", "check", "doctor"):
            self.answer(name, 0)

    def answer(self, name: str, status: int) -> None:
        (self.folder / name).write_text(str(status))

    def run(self, *arguments: str, expect: int = 0) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [str(INSTALL), "--prefix", str(self.prefix), "--python", str(self.python), *arguments],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == expect, done.stdout + done.stderr
        return done

    def current(self) -> Path:
        return (self.prefix / "opt/bikeped/venv").readlink()

    def releases(self) -> list[Path]:
        return sorted((self.prefix / "opt/bikeped/releases").iterdir())

    def calls(self) -> list[str]:
        return self.log.read_text().splitlines()


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_installs_everything_below_the_prefix_and_leaves_the_machine_alone(bench: Bench) -> None:
    done = bench.run()
    etc = bench.prefix / "etc"
    assert (etc / "systemd/system/bikeped.service").read_text() == UNIT.read_text()
    assert (etc / "systemd/system/bikeped-lamp.service").read_text() == LAMP_UNIT.read_text()
    assert (etc / "udev/rules.d/99-bikeped.rules").read_text() == RULES.read_text()
    assert (etc / "bikeped/config.yaml").read_text() == (ROOT / "config.yaml").read_text()
    assert (bench.prefix / "var/lib/bikeped").is_dir()
    assert (bench.prefix / "opt/bikeped/venv/bin/bikeped").is_file()
    release, config = bench.current(), etc / "bikeped/config.yaml"
    assert bench.calls()[1:] == [
        f"python -m venv --system-site-packages {release}",
        f"python -m pip install --upgrade {ROOT}[gpio,usb]",
        f"bikeped config check -c {config}",
        f"bikeped doctor -c {config}",
    ]
    for untouched in ("useradd", "systemctl enable", "udevadm trigger", "apt-get install"):
        assert f"left alone (--prefix): {untouched}" in done.stdout
    assert "journalctl -u bikeped -f" in done.stdout


def test_running_again_keeps_the_configuration_and_makes_a_new_release(bench: Bench) -> None:
    bench.run()
    config = bench.prefix / "etc/bikeped/config.yaml"
    config.write_text("camera: {height_m: 4.5}\n")
    first = bench.current()
    done = bench.run()
    assert config.read_text() == "camera: {height_m: 4.5}\n"
    assert f"kept: {config}" in done.stdout
    assert bench.current() != first
    assert (bench.prefix / "opt/bikeped/previous").readlink() == first


def test_dry_run_changes_nothing(bench: Bench) -> None:
    done = bench.run("--dry-run")
    assert not bench.prefix.exists()
    assert [line.split()[1] for line in bench.calls()] == ["-c"]
    for step in ("-m venv --system-site-packages", "pip install", "config check", "doctor"):
        assert re.search(rf"^would run: .*{step}", done.stdout, re.MULTILINE), step


def test_dry_run_without_a_prefix_names_every_change_of_the_machine(bench: Bench) -> None:
    done = subprocess.run(
        [str(INSTALL), "--dry-run", "--python", str(bench.python)],
        capture_output=True,
        text=True,
        check=True,
    )
    for step in (
        "useradd --system",
        "usermod --append --groups video,render,gpio,audio,plugdev bikeped",
        "mv -T /opt/bikeped/venv.new /opt/bikeped/venv",
        "/etc/systemd/system/",
        "/etc/udev/rules.d/",
        "runuser -u bikeped -- /opt/bikeped/venv/bin/bikeped doctor",
        "systemctl enable bikeped",
        "systemctl restart bikeped-lamp bikeped",
    ):
        assert step in done.stdout


def test_no_start_does_not_start(bench: Bench) -> None:
    assert "systemctl restart" in bench.run().stdout.split("Next:")[0]
    assert "systemctl restart" not in bench.run("--no-start").stdout.split("Next:")[0]


def test_a_package_that_does_not_install_leaves_the_current_release(bench: Bench) -> None:
    bench.run()
    first = bench.current()
    bench.answer("pip", 1)
    done = bench.run(expect=2)
    assert "current release stays" in done.stderr
    assert bench.current() == first
    assert bench.releases() == [first]


def test_a_release_that_refuses_the_configuration_never_becomes_current(bench: Bench) -> None:
    bench.run()
    first = bench.current()
    bench.answer("check", 2)
    done = bench.run(expect=2)
    assert "config.yaml" in done.stderr
    assert bench.current() == first
    assert bench.releases() == [first]


def test_a_doctors_finding_is_told_and_does_not_stop(bench: Bench) -> None:
    bench.answer("doctor", 1)
    assert "doctor found a problem" in bench.run().stdout


def test_rollback_goes_back_and_forth(bench: Bench) -> None:
    bench.run()
    first = bench.current()
    bench.run()
    second = bench.current()
    bench.run("--rollback")
    assert bench.current() == first
    bench.run("--rollback")
    assert bench.current() == second


def test_rollback_without_an_older_release_says_so(bench: Bench) -> None:
    bench.run()
    assert "no release to go back to" in bench.run("--rollback", expect=2).stderr


def test_rollback_refuses_a_release_that_refuses_the_configuration(bench: Bench) -> None:
    bench.run()
    bench.run()
    second = bench.current()
    bench.answer("check", 2)
    bench.run("--rollback", expect=2)
    assert bench.current() == second


def test_old_releases_are_dropped_but_never_the_two_in_use(bench: Bench) -> None:
    made = []
    for _ in range(5):
        bench.run()
        made.append(bench.current())
    assert bench.releases() == made[-3:]
    bench.run("--rollback")
    for _ in range(3):
        bench.run()
    assert len(bench.releases()) <= 4
    assert bench.current() in bench.releases()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--wrong"], "unknown argument: --wrong"),
        (["--source"], "--source needs a value"),
        (["--source", "/"], "no bikeped source tree"),
        (["--python", "python-none"], "no such program"),
    ],
)
def test_bad_arguments_end_with_2_and_one_reason(
    bench: Bench, arguments: list[str], message: str
) -> None:
    done = bench.run(*arguments, expect=2)
    assert message in done.stderr
    assert not bench.prefix.exists()


def test_a_python_that_is_too_new_is_refused(bench: Bench) -> None:
    bench.python.write_text(bench.python.read_text().replace("exit 0 ;;", "exit 1 ;;", 1))
    assert "3.10 to 3.12" in bench.run(expect=2).stderr


def test_without_root_the_machine_is_not_touched(tmp_path: Path) -> None:
    # `id -u` is all that the script asks; a fake one makes the answer the same for every tester.
    fake = tmp_path / "id"
    fake.write_text("#!/bin/sh\necho 1000\n")
    fake.chmod(0o755)
    done = subprocess.run(
        [str(INSTALL)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"},
    )
    assert done.returncode == 2
    assert "needs root" in done.stderr
    assert done.stdout == ""


def test_the_script_parses_and_is_strict() -> None:
    subprocess.run(["bash", "-n", str(INSTALL)], check=True)
    assert "set -euo pipefail" in INSTALL.read_text()
    assert os.access(INSTALL, os.X_OK)


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is not installed")
def test_shellcheck_finds_nothing() -> None:
    subprocess.run(["shellcheck", str(INSTALL)], check=True)


def unit_values(key: str) -> list[str]:
    return [
        line.split("=", 1)[1]
        for line in UNIT.read_text().splitlines()
        if line.startswith(f"{key}=")
    ]


def test_the_unit_starts_watches_and_darkens() -> None:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.read_string(UNIT.read_text())
    assert parser.sections() == ["Unit", "Service", "Install"]
    assert unit_values("ExecStart") == [
        "/opt/bikeped/venv/bin/bikeped run -c /etc/bikeped/config.yaml --last-good /var/lib/bikeped"
    ]
    assert unit_values("Type") == ["notify"]
    assert unit_values("NotifyAccess") == ["main"]
    assert unit_values("WatchdogSec") == ["4"]
    assert unit_values("Restart") == ["always"]
    assert unit_values("StartLimitIntervalSec") == ["0"]
    assert unit_values("User") == ["bikeped"]
    (stop_post,) = unit_values("ExecStopPost")
    module = stop_post.split(" -m ")[1].split()[0]
    assert (ROOT / module.replace(".", "/") / "__main__.py").is_file()


def test_the_unit_does_not_lock_cuda_or_usb_out() -> None:
    assert unit_values("MemoryDenyWriteExecute") == []
    assert unit_values("PrivateDevices") == []
    allowed = unit_values("DeviceAllow")
    for device in ("char-video4linux", "char-gpiochip", "char-alsa", "char-usb_device"):
        assert f"{device} rw" in allowed
    assert "AF_NETLINK" in unit_values("RestrictAddressFamilies")[0].split()


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
@pytest.mark.parametrize("file", [UNIT, LAMP_UNIT])
def test_systemd_accepts_the_unit(tmp_path: Path, file: Path) -> None:
    # The programs of a pole are not on the tester's machine: any program stands for them.
    unit = tmp_path / file.name
    unit.write_text(re.sub(r"=(-?)/opt/bikeped/venv/bin/\S+", r"=\1/bin/true", file.read_text()))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)],
        capture_output=True,
        text=True,
        check=False,
    )
    complaints = [
        line for line in done.stderr.splitlines() if file.name in line or str(unit) in line
    ]
    assert complaints == []


def test_udev_rules_match_what_the_code_drives() -> None:
    from bikeped.lamp.usb import _DEVICES

    text = RULES.read_text()
    for _, vendor, product in _DEVICES.values():
        assert f'ATTR{{idVendor}}=="{vendor:04x}", ATTR{{idProduct}}=="{product:04x}"' in text
    for line in text.splitlines():
        if line and not line.startswith("#"):
            assert all(re.fullmatch(r'[A-Z_]+(\{[^}]+\})?(==|!=|\+=|=)"[^"]*"', part.strip())
                       for part in line.split(", ")), line  # fmt: skip
    assert 'SYMLINK+="bikeped-camera"' in text
