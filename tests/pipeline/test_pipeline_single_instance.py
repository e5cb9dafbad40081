"""A second service of one configuration is refused; the doctor keeps off what the first holds."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
from small_crossing import PATIENCE_S

from bikeped.config.load import load_config
from bikeped.errors import ConfigError
from bikeped.pipeline import doctor
from bikeped.pipeline.doctor import checks
from bikeped.pipeline.single_instance import claimed, claims_of, holder


def test_what_is_held_is_the_file_the_wired_light_and_the_camera_device(small_config):
    config = small_config("/dev/video7", more="feedback: {light: usb, usb: {device: relay}}\n")
    held = claims_of(load_config(config))
    assert set(held) == {str(config), "the usb light", "/dev/video7"}
    assert claims_of(load_config(config, ["camera.source='7'"]))["/dev/video7"] == "/dev/video7"
    rehearsal = load_config(config, ["camera.source=day.avi", "feedback.light=simulated"])
    assert set(claims_of(rehearsal)) == {str(config)}
    lamp = load_config(config, ["feedback.light=lamp", "lamp.driver=gpio"])
    assert "/run/bikeped/lamp.socket" in claims_of(lamp)["the lamp light"]


async def test_a_claim_is_exclusive_names_its_holder_and_ends(small_config, tmp_path):
    loaded = load_config(small_config())
    assert holder(loaded) is None
    with claimed(loaded):
        assert holder(loaded) == (loaded.source, os.getpid())
        with pytest.raises(ConfigError, match=rf"in use .*pid {os.getpid()}\)"), claimed(loaded):
            pass
        assert holder(loaded) is not None  # the refused one has taken nothing away
    assert holder(loaded) is None
    with claimed(loaded):
        pass


async def test_a_refused_second_service_leaves_what_only_it_claimed(small_config, tmp_path):
    first = load_config(small_config(), ["camera.source=/dev/video7"])
    copy = tmp_path / "copy.yaml"
    copy.write_text((tmp_path / "small.yaml").read_text())
    second = load_config(copy, ["camera.source=/dev/video7"])
    with claimed(first):
        with pytest.raises(ConfigError, match="/dev/video7 is in use"), claimed(second):
            pass
        alone = load_config(copy, ["camera.source=/dev/video8"])
        with claimed(alone):
            pass


async def test_a_holder_that_answers_nobody_is_still_a_holder(small_config, monkeypatch):
    monkeypatch.setattr("bikeped.pipeline.single_instance._PENDING", 0)
    loaded = load_config(small_config())
    with claimed(loaded):  # this coroutine does not give the loop the time to accept
        asking = [holder(loaded) for _ in range(3)]
        assert asking[0] == (loaded.source, os.getpid())
        assert None not in asking


def test_a_second_service_ends_with_2_and_the_pid_of_the_first(start, make_clip, small_config):
    config = small_config(make_clip("day.avi", 900))
    first = start(config)
    first.until_told("READY=1")
    second = start(config)
    assert second.wait() == 2
    assert re.search(rf"bikeped: .* in use by another .*pid {first.process.pid}\)", second.log)
    assert "simulated light" not in second.log  # it touches no lamp
    assert first.process.poll() is None


def test_the_doctor_leaves_to_the_running_service_what_it_holds(start, make_clip, small_config):
    config = small_config(make_clip("day.avi", 900))
    first = start(config)
    first.until_told("READY=1")
    done = subprocess.run(
        [sys.executable, "-m", "bikeped.cli.main", "doctor", "-c", str(config)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        env={**os.environ, "COLUMNS": "200"},
    )
    for name in ("camera", "model", "light", "speaker"):
        assert re.search(rf"skipped +{name} +.*pid {first.process.pid}", done.stdout), done.stdout


async def test_beside_a_running_service_no_check_may_take_long(small_config, monkeypatch):
    loaded = load_config(small_config())
    touched = []
    for name in ("check_camera", "check_model", "check_light", "check_speaker"):
        monkeypatch.setattr(doctor, name, lambda _loaded, name=name: touched.append(name))
    todo = checks(beside=("small.yaml", 4711))
    assert sum(limit_s for _name, _check, limit_s in todo) <= doctor.BESIDE_SERVICE_S
    names = [name for name, _check, _limit in todo]
    assert names == [name for name, _check, _limit in checks()]
    findings = [check(loaded) for name, check, _limit in todo if name in ("camera", "light")]
    assert [f.status for f in findings] == ["skipped", "skipped"]
    assert "small.yaml" in findings[0].detail
    assert touched == []
