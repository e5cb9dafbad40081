"""What `run` refuses or warns of in a valid configuration, and lens files that make no sense."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from bikeped.config.edit import set_values
from bikeped.config.lens_check import checksum
from bikeped.config.load import load_config, parse_config
from bikeped.config.runnable import check_runnable, is_complete, warnings
from bikeped.errors import BikepedError, ConfigError

TOP = Path(__file__).parents[2]
BUNDLED = (TOP / "config.yaml").read_text()
LENS = json.loads((TOP / "camera_calibration.json").read_text())
NO_FILE = "camera: {source: a.mp4, radius_px: 1750, fov_deg: 197.9}\nfeedback: {light: simulated}\n"


def parse(text, *overrides):
    return parse_config(text, "site.yaml", Path("nowhere"), overrides)


def refusal(text, *overrides):
    with pytest.raises(ConfigError) as refused:
        check_runnable(parse(text, *overrides))
    line = str(refused.value)
    assert line.startswith("site.yaml: ")
    assert "\n" not in line
    return line


def test_the_bundled_configuration_runs_without_a_warning():
    loaded = load_config(TOP / "config.yaml")
    check_runnable(loaded)
    assert is_complete(loaded)
    assert list(warnings(loaded)) == []


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (NO_FILE.replace("source: a.mp4, ", ""), "camera.source: missing"),
        (NO_FILE.splitlines()[0], "feedback.light: missing"),
        (NO_FILE.replace("simulated", "gpio"), "feedback.gpio.chip: missing"),
        (NO_FILE.replace("simulated", "usb"), "feedback.usb.device: missing"),
        (NO_FILE + "decision: {memory_frames: 0}\n", "decision.memory_frames: 0"),
        (NO_FILE.replace("fov_deg", "k1: 2, fov_deg"), "camera: k1..k4: change the radius"),
    ],
)
def test_what_run_refuses(text, part):
    parse(text)  # valid otherwise: for replay, demo, conformance
    assert part in refusal(text)


def test_an_override_names_hardware_too():
    check_runnable(parse(NO_FILE.splitlines()[0], "feedback.light=simulated"))


@pytest.mark.parametrize(
    ("keys", "part"),
    [
        ("height_m: 12", "camera.height_m: 12 m .*are these feet"),
        ("height_m: 1.2", r"camera.height_m: 1\.2 m is low"),
        ("pitch_deg: 15", "camera.pitch_deg: 15 looks up"),
        ("cy: 17", "camera.cy: 17 is far from the middle"),
        ("cx: 2500", "camera.cx: 2500 is far from the middle"),
    ],
)
def test_what_is_more_often_a_mistake(keys, part):
    (line,) = warnings(
        parse(f"camera: {{radius_px: 1750, fov_deg: 197.9, {keys}}}\ncomplete: true")
    )
    assert line.startswith(part.partition(" ")[0])
    assert re.match(part, line)


@pytest.mark.parametrize("host", ["http://broker", "broker:1883", "a b", "user@broker", "broker/x"])
def test_a_host_is_no_address(host):
    with pytest.raises(ConfigError, match=r"mqtt\.host: .* is no host"):
        parse(NO_FILE + f"mqtt: {{host: '{host}'}}\n")


@pytest.mark.parametrize("host", ["broker", "broker.lan", "10.0.0.7", "::1", "fe80::1%eth0"])
def test_hosts(host):
    assert parse(NO_FILE + f"mqtt: {{host: '{host}'}}\n").config.mqtt.host == host


@pytest.mark.parametrize(
    "keys",
    [
        "camera: {stale_after_s: 60}",
        "camera: {stale_after_s: 2.1}",
        "detection: {silent_after_s: 60}",
        "detection: {confidence: 1}",
        "camera: {hang_after_s: 61}",
        "feedback: {blink_hz: 0.01}",
        "feedback: {fault_blink_hz: 0.01}",
        "feedback: {recover_frames: 10000}",
    ],
)
def test_times_that_safety_hangs_on_are_bounded(keys):
    with pytest.raises(ConfigError, match="use a value"):
        parse(keys)


def test_only_the_whole_file_counts_as_complete():
    for text, whole in (
        ("complete: true\n", True),
        ("complete: true  # a note\n# and more\n\n", True),
        ("complete: true\nweb: {port: 1}\n", False),
        ("complete: false\n", False),
        ("# complete: true\n", False),
        ("", False),
    ):
        assert is_complete(parse(NO_FILE + text)) is whole, text


def test_a_cut_off_file_is_never_taken_for_a_whole_one():
    assert BUNDLED.rstrip().endswith("lacks it")
    end = BUNDLED.index("complete: true") + len("complete: true")
    for length in range(end):
        try:
            loaded = parse_config(BUNDLED[:length], "cut.yaml", TOP)
        except BikepedError:
            continue
        assert not is_complete(loaded), BUNDLED[:length][-40:]
    assert is_complete(parse_config(BUNDLED[:end], "cut.yaml", TOP))


def test_a_configuration_that_is_no_file_is_refused_at_once(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/zero"), tmp_path):
        with pytest.raises(ConfigError, match="not a regular file"):
            load_config(path)
    with pytest.raises(BikepedError, match="not a regular file"):
        parse(f"camera: {{calibration: {pipe}}}")


def with_lens(tmp_path, text=None, **changes):
    values = {
        k: v for k, v in {**LENS, **changes}.items() if k != "checksum" or "checksum" in changes
    }
    (tmp_path / "lens.json").write_text(text or json.dumps(values))
    camera = "{calibration: lens.json}"
    return parse_config(f"camera: {camera}", "site.yaml", tmp_path)


MUTANTS = [
    {"focal_length": 0.001},
    {"focal_length": 2026.6},
    {"focal_length": -1013.3},
    {"focal_length": 1.2, "radius_px": None},
    {"fov_deg": 100},
    {"fov_deg": 360},
    {"fov_deg": 0},
    {"radius_px": 3500},
    {"radius_px": 17.5},
    {"k1": 5},
    {"k1": -0.5},
    {"k2": 1.0},
    {"k4": -3},
    {"cx": 17},
    {"cy": 3400},
    {"cx": -1752.69},
    {"rms_error_px": -1},
    {"rms_error_px": 400},
    {"num_frames": 0},
    {"num_points": -5},
    {"model": "equisolid"},
    {"model": "pinhole"},
    {"frame_width": 2160, "frame_height": 3840},
    {"crop_size": 3840},
    {"pad_size": 0},
    {"focal_length": None},
    {"k1": "0"},
]


@pytest.mark.parametrize("changes", MUTANTS, ids=str)
def test_a_lens_file_that_makes_no_sense(tmp_path, changes):
    with pytest.raises(BikepedError) as refused:
        with_lens(tmp_path, **changes)
    assert str(refused.value).startswith(str(tmp_path / "lens.json"))


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999"])
def test_a_lens_file_without_numbers(tmp_path, number):
    with pytest.raises(BikepedError):
        with_lens(tmp_path, json.dumps(LENS).replace("1752.69", number))


def test_a_checksum_finds_what_no_range_can(tmp_path):
    total = checksum(LENS)
    with_lens(tmp_path, checksum=total)
    with_lens(tmp_path, checksum=total, radius_px=1750, note="kept out", k3=0)
    for swap in ({"cx": LENS["cy"], "cy": LENS["cx"]}, {"cx": 1752.7}, {"k1": 1e-4}):
        with_lens(tmp_path, **swap)
        with pytest.raises(ConfigError, match="checksum: does not fit"):
            with_lens(tmp_path, checksum=total, **swap)


def test_the_bundled_calibration_has_its_checksum():
    assert LENS["checksum"] == checksum(LENS)
    assert list(LENS)[-1] == "complete"


def test_a_new_section_goes_before_the_last_line():
    text = NO_FILE + "complete: true\n"
    after = set_values(text, {"web": {"port": 1}}, "site.yaml")
    assert is_complete(parse(after))
    assert parse(after).config.web.port == 1
