"""The bundled model is never loaded with another content."""

from __future__ import annotations

import hashlib

import pytest

from bikeped.config.schema import DetectionConfig
from bikeped.detection import detector
from bikeped.errors import DetectorError
from bikeped.models import BUNDLED_SHA256


def test_the_hashes_are_those_of_the_files() -> None:
    for path, digest in BUNDLED_SHA256.items():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == digest


def test_another_bundled_file_is_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(detector, "BUNDLED_SHA256", dict.fromkeys(BUNDLED_SHA256, "0" * 64))
    with pytest.raises(DetectorError, match="SHA-256"):
        detector.load_detector(DetectionConfig(model="bundled", providers=("cpu",)), tmp_path)
