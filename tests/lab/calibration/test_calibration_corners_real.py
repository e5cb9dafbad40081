"""Fifteen real pictures through a real lens: all boards, and the same corners at any size."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from shared_inputs import SHARED

from bikeped.lab.calibration.board_view import BoardPattern, DetectedBoards
from bikeped.lab.calibration.capture.images import load_images
from bikeped.lab.calibration.corners.board_detector import detect_board
from bikeped.lab.calibration.image_pipeline import detect_boards

PATTERN = BoardPattern(8, 6)
FOLDER = SHARED / "media" / "fisheye-checkerboard"
NAMES = [f"Fisheye1_{number}.jpg" for number in range(1, 16)]

pytestmark = pytest.mark.skipif(
    not all((FOLDER / name).is_file() for name in NAMES), reason=f"no pictures in {FOLDER}"
)


@pytest.fixture(scope="module")
def found() -> DetectedBoards:
    return detect_boards(load_images([FOLDER]), PATTERN)


def test_every_picture_gives_its_whole_board(found: DetectedBoards) -> None:
    assert [Path(view.name).name for view in found.views] == NAMES
    assert [len(view) for view in found.views] == [48] * 15
    assert not found.refused
    digests = [hashlib.sha256((FOLDER / name).read_bytes()).digest() for name in sorted(NAMES)]
    assert found.images_hash == hashlib.sha256(b"".join(digests)).hexdigest()


def test_pictures_of_a_third_of_the_size_give_the_same_corners(found: DetectedBoards) -> None:
    """Detected anew, with other squares, windows and detectors: a wrong corner would not agree."""
    off = []
    for picture, view in zip(load_images([FOLDER]), found.views, strict=True):
        size = (picture.width // 3, picture.height // 3)
        small = cv2.resize(picture.grey(), size, interpolation=cv2.INTER_AREA)
        seen = detect_board(np.asarray(small, np.uint8), PATTERN)
        assert len(seen.ids) == 48
        ratio = np.array([picture.width / size[0], picture.height / size[1]])
        expected = (view.uv_px + 0.5) / ratio - 0.5
        off.append(np.linalg.norm(seen.uv_px - expected, axis=1))
    assert np.sqrt(np.mean(np.square(off))) < 0.04
    assert np.max(off) < 0.15
