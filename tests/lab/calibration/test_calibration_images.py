"""Files, folders and videos in, pictures of one size out; what cannot be read is named."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from bikeped.errors import CalibrationError
from bikeped.lab.calibration.capture.images import images_hash, load_images, sharpness


def write(path: Path, width: int = 64, height: int = 48, seed: int = 0) -> Path:
    rng = np.random.default_rng(seed)
    cv2.imwrite(str(path), rng.integers(0, 255, (height, width, 3)).astype(np.uint8))
    return path


def test_files_and_folders_in_natural_order(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        write(tmp_path / f"{number}.png", seed=number)
    (tmp_path / "notes.txt").write_text("no picture")
    extra = write(tmp_path.parent / f"{tmp_path.name}-extra.jpg", seed=9)
    pictures = load_images([tmp_path, extra])
    assert [Path(one.name).name for one in pictures[:3]] == ["1.png", "2.png", "10.png"]
    assert all((one.width, one.height) == (64, 48) for one in pictures)
    assert pictures[3].grey().shape == (48, 64)
    extra.unlink()


def test_the_hash_is_of_the_bytes_in_order_of_name(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"{name}.png", seed=n) for n, name in enumerate("ab")]
    expected = hashlib.sha256()
    for path in paths:
        expected.update(hashlib.sha256(path.read_bytes()).digest())
    assert images_hash(load_images(paths)) == expected.hexdigest()
    assert images_hash(load_images(paths[::-1])) == expected.hexdigest()
    write(paths[1], seed=7)
    assert images_hash(load_images(paths)) != expected.hexdigest()


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    good = write(tmp_path / "good.png")
    broken = tmp_path / "broken.png"
    broken.write_bytes(good.read_bytes()[:60])
    for path, words in (
        (broken, "broken.png: is no picture that can be decoded; remove it"),
        (tmp_path / "none.jpg", "none.jpg: no such file or folder"),
    ):
        with pytest.raises(CalibrationError, match=words):
            load_images([good, path])
    text = tmp_path / "text.jpg"
    text.write_text("hello")
    with pytest.raises(CalibrationError, match=r"text\.jpg: .*remove it"):
        load_images([text])
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(CalibrationError, match="holds no pictures"):
        load_images([empty])
    with pytest.raises(CalibrationError, match="no picture to calibrate from"):
        load_images([])


def test_a_jpeg_that_ends_in_its_header_is_refused(tmp_path: Path) -> None:
    cut = write(tmp_path / "cut.jpg", 640, 480)
    cut.write_bytes(cut.read_bytes()[:200])
    with pytest.raises(CalibrationError, match=r"cut\.jpg: .*remove it"):
        load_images([cut])


def test_sizes_must_agree(tmp_path: Path) -> None:
    first, other = write(tmp_path / "a.png"), write(tmp_path / "b.jpg", 80, 48)
    with pytest.raises(CalibrationError, match=r"b\.jpg: is 80x48 pixels, but .*a\.png is 64x48"):
        load_images([first, other])


def test_a_thumbnail_holds_no_board(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "tiny.png"), np.zeros((1, 1), np.uint8))
    with pytest.raises(CalibrationError, match=r"tiny\.png: is 1x1 pixels, too small"):
        load_images([tmp_path / "tiny.png"])


def test_a_video_gives_the_sharpest_frame_of_every_half_second(tmp_path: Path) -> None:
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    rng = np.random.default_rng(3)
    sharp = cv2.resize(
        rng.integers(0, 255, (12, 16, 3)).astype(np.uint8), (64, 48), interpolation=0
    )
    for number in range(15):
        blur = 0 if number in (2, 8, 11) else 3
        writer.write(np.asarray(cv2.GaussianBlur(sharp, (0, 0), blur), np.uint8) if blur else sharp)
    writer.release()
    pictures = load_images([path])
    assert [one.name for one in pictures] == [f"{path} frame {n}" for n in (2, 8, 11)]
    assert all(one.moving for one in pictures)
    assert pictures[0].grey().shape == (48, 64)
    damaged = tmp_path / "damaged.mp4"
    damaged.write_bytes(b"\0" * 300)
    with pytest.raises(CalibrationError, match=r"damaged\.mp4"):
        load_images([damaged])


def test_sharpness_falls_with_blur() -> None:
    rng = np.random.default_rng(1)
    picture = rng.integers(0, 255, (480, 1400)).astype(np.uint8)
    blurred = np.asarray(cv2.GaussianBlur(picture, (0, 0), 2.0), np.uint8)
    assert sharpness(picture) > 2 * sharpness(blurred)
