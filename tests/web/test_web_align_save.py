"""Saving an alignment into config.yaml."""

from __future__ import annotations

import hashlib
import os
from datetime import datetime, timezone
from pathlib import Path

import pytest

from bikeped.config.load import load_config
from bikeped.errors import BikepedError, ConfigError
from bikeped.web.align_save import ChangedError, file_hash, lines, save, why_not

ROOT = Path(__file__).parents[2]
NOW = datetime(2026, 5, 4, 10, 20, 30, tzinfo=timezone.utc)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """The repository's configuration and calibration, to spoil."""
    for name in ("config.yaml", "camera_calibration.json"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    return tmp_path / "config.yaml"


def test_only_the_keys_change_and_the_file_before_stays(place: Path) -> None:
    before = place.read_text()
    place.chmod(0o640)
    saved = save(
        place, {"height_m": 4.123456, "pitch_deg": -7.25, "cx": 1700.5}, file_hash(place), NOW
    )
    assert saved.backup.name == "config.yaml.2026-05-04-102030.bak"
    assert saved.backup.read_text() == before
    assert saved.sha256 == file_hash(place)
    assert not saved.promoted
    after = place.read_text()
    changed = [
        (a, b) for a, b in zip(before.splitlines(), after.splitlines(), strict=False) if a != b
    ]
    assert changed[:2] == [
        ("  height_m: 3.6576        # 12 ft", "  height_m: 4.1235        # 12 ft"),
        ("  pitch_deg: 0.0", "  pitch_deg: -7.25"),
    ]
    assert "  crop_size: 3500\n  cx: 1700.5\n\ndetection:" in after
    assert len(after.splitlines()) == len(before.splitlines()) + 1
    camera = load_config(place).config.camera
    assert (camera.height_m, camera.pitch_deg, camera.cx) == (4.1235, -7.25, 1700.5)
    assert {p.stat().st_mode & 0o777 for p in (place, saved.backup)} == {0o640}
    assert sorted(p.name for p in place.parent.iterdir()) == [
        "camera_calibration.json",
        "config.yaml",
        saved.backup.name,
    ]


def test_two_saves_in_a_second_keep_both_files(place: Path) -> None:
    first = save(place, {"height_m": 4}, file_hash(place), NOW)
    second = save(place, {"height_m": 5}, first.sha256, NOW)
    assert first.backup != second.backup
    assert load_config(second.backup).config.camera.height_m == 4
    assert load_config(place).config.camera.height_m == 5


def test_a_link_stays_a_link_and_a_promoted_decision_is_told(place: Path, tmp_path: Path) -> None:
    (place.parent / "config.provenance.json").write_text("{}")
    link = tmp_path / "elsewhere" / "site.yaml"
    link.parent.mkdir()
    link.symlink_to(place)
    (link.parent / "camera_calibration.json").write_bytes(
        (place.parent / "camera_calibration.json").read_bytes()
    )
    saved = save(link, {"pitch_deg": -3}, file_hash(link))
    assert saved.promoted
    assert link.is_symlink()
    assert load_config(place).config.camera.pitch_deg == -3


@pytest.mark.parametrize("key", ["d_max_m", "decision", "source", "calibration", "fov_deg"])
def test_nothing_but_the_camera_s_numbers_can_be_written(place: Path, key: str) -> None:
    before = place.read_bytes()
    with pytest.raises(ConfigError, match=f"{key} is not for a page"):
        save(place, {key: 1.0}, file_hash(place))
    assert place.read_bytes() == before


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"height_m": 0}, "camera.height_m"),
        ({"height_m": 1000}, "camera.height_m"),
        ({"pitch_deg": 91}, "camera.pitch_deg"),
        ({"height_m": float("nan")}, "camera"),
        ({"radius_px": -5}, "camera.radius_px"),
        ({}, "nothing is not"),
    ],
)
def test_values_that_cannot_be_are_refused_whole(place: Path, values, says: str) -> None:
    before = place.read_bytes()
    with pytest.raises(ConfigError, match=says):
        save(place, {"cy": 1800, **values} if values else values, file_hash(place))
    assert place.read_bytes() == before
    assert len(list(place.parent.iterdir())) == 2


def test_another_hand_is_noticed_also_at_the_last_moment(place: Path, monkeypatch) -> None:
    opened = file_hash(place)
    place.write_text(place.read_text() + "\n# a note\n")
    with pytest.raises(ChangedError, match="changed after this page was opened"):
        save(place, {"height_m": 4}, opened)

    import bikeped.web.align_save as saving

    real = saving.write_like

    def slow(path: Path, content: bytes, like: Path) -> None:
        real(path, content, like)
        place.write_text(place.read_text() + "# meanwhile\n")

    monkeypatch.setattr(saving, "write_like", slow)
    with pytest.raises(ChangedError):
        save(place, {"height_m": 4}, file_hash(place))
    assert load_config(place).config.camera.height_m == 3.6576
    assert len(list(place.parent.iterdir())) == 2


def test_a_full_disk_leaves_the_file_and_no_scraps(place: Path, monkeypatch) -> None:
    before, opened = place.read_bytes(), file_hash(place)
    calls = []

    def no_room(handle: int) -> None:
        calls.append(handle)
        if len(calls) == 2:  # the backup fits, the file does not
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_room)
    with pytest.raises(BikepedError, match="No space left"):
        save(place, {"height_m": 4}, opened)
    assert place.read_bytes() == before
    assert len(list(place.parent.iterdir())) == 2


def test_who_may_not_write_is_told_and_gets_lines_to_copy(tmp_path: Path) -> None:
    assert "is not there" in (why_not(tmp_path / "none.yaml") or "")
    assert lines({"pitch_deg": -0.00001, "height_m": 3}) == (
        "camera:\n  height_m: 3.0\n  pitch_deg: 0.0\n"
    )
    path = tmp_path / "c.yaml"
    path.write_text("camera: {radius_px: 1750, fov_deg: 197.9}\n")
    assert why_not(path) is None
    assert file_hash(path) == hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_file_that_this_process_may_not_write(place: Path, monkeypatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != place)  # root may do all
    assert "may not write" in (why_not(place) or "")
