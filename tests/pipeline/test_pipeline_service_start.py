"""The service on a pole: a broken configuration, a cut-off one, and a service that keeps ending."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import pytest

from bikeped.config.last_good import LastGood, load_runnable
from bikeped.config.load import load_config
from bikeped.errors import BikepedError, ConfigError
from bikeped.pipeline.service_start import EarlyEnds, ServiceStart, pause_s, start_on_pole

TOP = Path(__file__).parents[2]


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """The bundled files as a pole has them, with a lamp on GPIO lines."""
    text = (TOP / "config.yaml").read_text()
    lamp = "gpio\n  gpio: {chip: x, red: 1, orange: 2, green: 3, blue: 4}"
    path = tmp_path / "etc" / "config.yaml"
    path.parent.mkdir()
    path.write_text(text.replace("simulated ", f"{lamp} ").replace("model: null", "model: m.onnx"))
    shutil.copy(TOP / "camera_calibration.json", path.parent)
    assert load_config(path).config.feedback.light == "gpio"
    return path


def test_the_copy_is_whole_and_its_paths_start_where_they_did(site: Path, tmp_path: Path) -> None:
    kept = LastGood(tmp_path / "state")
    kept.folder.mkdir()
    assert kept.load(site) is None
    loaded = load_runnable(site)
    kept.keep(loaded)
    site.with_name("camera_calibration.json").unlink()
    copy = kept.load(site)
    assert copy is not None
    assert copy.hash == loaded.hash
    assert copy.source == str(tmp_path / "state" / "last-good" / "config.yaml")
    assert copy.path("m.onnx") == site.parent / "m.onnx"
    assert load_config(Path(copy.source)).hash == loaded.hash  # so that a person may copy it back


def test_a_newer_copy_replaces_the_older_one(site: Path, tmp_path: Path) -> None:
    kept = LastGood(tmp_path)
    site.with_name("config.provenance.json").write_text("{}")
    kept.keep(load_runnable(site))
    kept.keep(load_runnable(site))
    site.write_text("# newer\n" + site.read_text())
    kept.keep(load_runnable(site))
    assert len(list(tmp_path.glob("kept-*"))) == 1
    assert sorted(p.name for p in (tmp_path / "last-good").iterdir()) == [
        "camera_calibration.json",
        "config.provenance.json",
        "config.yaml",
    ]
    (tmp_path / "last-good" / "config.yaml").unlink()
    assert kept.load(site) is None


def test_of_all_cut_off_files_none_runs_where_the_copy_was_whole(
    site: Path, tmp_path: Path
) -> None:
    text = site.read_text()
    end = text.index("complete: true") + len("complete: true")
    good = load_runnable(site)
    for length in range(end):
        site.write_text(text[:length])
        with pytest.raises(BikepedError):
            load_runnable(site, (), good)
    # Without a copy some run, but none with a simulated light for a real one.
    simulated = 0
    for length in range(0, end, 3):
        site.write_text(text[:length])
        try:
            simulated += load_runnable(site).config.feedback.light != "gpio"
        except BikepedError:
            continue
    assert simulated == 0


def test_early_ends_are_counted_without_a_clock(tmp_path: Path) -> None:
    def started() -> int:
        return EarlyEnds(tmp_path / "starts.json").begin()

    assert [started() for _ in range(4)] == [0, 1, 2, 3]
    EarlyEnds(tmp_path / "starts.json").settle()
    assert started() == 0
    for damaged in ("", "{", "[]", '{"early_ends": "x"}', '{"early_ends": null}'):
        (tmp_path / "starts.json").write_text(damaged)
        assert started() == 0
    assert EarlyEnds(tmp_path / "none" / "starts.json").begin() == 0  # warns, and runs


def test_the_pause_grows_to_a_minute() -> None:
    pauses = [pause_s(number) for number in range(12)]
    assert pauses[:3] == [0, 0, 0]
    assert pauses[3:9] == [2, 4, 8, 16, 32, 60]
    assert pauses == sorted(pauses)


def started(site: Path, state: Path, *failing: Exception) -> list[tuple[str, ServiceStart]]:
    """What was served, with a service that fails at first."""
    served, left = [], list(failing)

    def serve(loaded, start) -> int:
        served.append((loaded.source, start))
        if left:
            raise left.pop(0)
        if start.on_well is not None:
            start.on_well()
        return 0

    assert start_on_pole(site, (), state, serve) == 0
    return served


def test_a_broken_file_runs_on_the_copy_after_five_seconds(site: Path, tmp_path: Path) -> None:
    state, text = tmp_path / "state", site.read_text()
    ((source, plain),) = started(site, state)
    assert (source, plain.fault_s, plain.notice) == (str(site), 0, None)
    for broken in ("", text[:300], text.replace("height_m: 3.6576", "height_m: tall")):
        site.write_text(broken)
        ((source, onward),) = started(site, state)
        assert source.endswith("last-good/config.yaml")
        assert onward.fault_s >= 5
        assert onward.notice is not None
        assert onward.notice.code == "service.last_good_config"
        assert onward.on_well is None
    # A model that cannot be loaded is seen only by the service itself.
    site.write_text(text.replace("m.onnx", "gone.onnx"))
    (first, second) = started(site, state, ConfigError("detection.model: gone"))
    assert first[0] == str(site)
    assert second[0].endswith("last-good/config.yaml")


def test_without_a_copy_or_with_the_same_one_the_error_is_the_end(
    site: Path, tmp_path: Path
) -> None:
    state, text = tmp_path / "state", site.read_text()
    site.write_text("camera: [")
    with pytest.raises(ConfigError, match="not YAML"):
        started(site, state)
    site.write_text(text)
    started(site, state)
    with pytest.raises(ConfigError, match="gone"):
        started(site, state, ConfigError("gone"))


def test_the_state_folder_may_be_missing_or_read_only(site: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    ((source, _),) = started(site, tmp_path / "file" / "state")
    assert source == str(site)


# ---- the real process


def test_killed_with_a_broken_file_it_runs_on_and_says_so(
    start, make_clip, small_config, tmp_path
) -> None:
    config, state = small_config(make_clip("day.avi", 3000)), tmp_path / "state"
    config.write_text(config.read_text() + "complete: true\n")
    options = ("--last-good", str(state))
    service = start(config, *options)
    service.until_said("SAFE: ")
    service.until_said("runs well: kept in")
    config.write_text(config.read_text()[:200])
    service.stop(signal.SIGKILL)
    again = start(config, *options)
    again.until_said(r"small\.yaml: .*; running on the last good configuration")
    again.until_said("simulated light: orange")
    assert "green" not in again.log
    again.until_said("simulated light: green")
    again.until_said(r"configuration: the last good one runs: .*small\.yaml")
    assert again.stop() == 0
    assert json.loads((state / "starts.json").read_text()) == {"early_ends": 0}


def test_a_crash_loop_shows_no_green(start, make_clip, small_config, tmp_path) -> None:
    config, state = small_config(make_clip("day.avi", 3000)), tmp_path / "state"
    options = ("--last-good", str(state))
    service = start(config, *options)
    service.until_said("simulated light: green")
    service.stop(signal.SIGKILL)
    for number in range(1, 4):
        service = start(config, *options)
        service.until_said(f"{number} starts in a row ended early")
        service.until_told("READY=1")
        service.until_said("FAULT: service: it ended soon after its start before")
        service.stop(signal.SIGKILL)
        assert "green" not in service.log
        assert "blue" not in service.log
    assert json.loads((state / "starts.json").read_text()) == {"early_ends": 4}


def test_green_comes_back_once_it_has_held(start, make_clip, small_config, tmp_path) -> None:
    config, state = small_config(make_clip("day.avi", 3000)), tmp_path / "state"
    state.mkdir()
    (state / "starts.json").write_text('{"early_ends": 1}')
    service = start(config, "--last-good", str(state))
    service.until_said("FAULT: service: it ended soon after its start before")
    service.until_said("simulated light: green")
    assert service.stop() == 0
