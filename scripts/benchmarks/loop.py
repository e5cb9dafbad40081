"""The whole loop from a 4K MJPEG recording with a real model, against one step after another."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

if TYPE_CHECKING:
    from benchmarks.figures import Figures

MODEL = Path(__file__).parents[3] / "shared" / "models" / "yolox_nano.onnx"
FRAMES, DISTINCT = 240, 24


def run(figures: Figures) -> None:
    """Frames a second on this machine's cores, recording on disk to decision."""
    if not MODEL.is_file():
        print("loop: left out, for ../shared/models/yolox_nano.onnx is not there")
        return
    from benchmarks.pictures import street_4k
    from bikeped.config import load_config
    from bikeped.lab.rendering.avi_writer import AviWriter
    from bikeped.pipeline.replay import replay

    pictures = street_4k(DISTINCT)
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "4k.avi"
        with AviWriter(clip, 30, (3840, 2160)) as writer:
            for i in range(FRAMES):
                writer.write(pictures[i % DISTINCT])
        settings = [f"detection.model={MODEL}", "detection.threads=1", "detection.providers=[cpu]"]
        loaded = load_config(overrides=settings)
        ours, obvious, total_ms = [], [], []
        for _ in range(3):
            result = replay(loaded, str(clip), mqtt=False)
            ours.append(result.frames / result.wall_s)
            total_ms.append(result.times.percentiles()["total"]["p95"])
            obvious.append(_one_after_another(clip, MODEL))
    figures.add(
        "4K MJPEG recording to decision", sorted(ours)[1], sorted(obvious)[1], "frames/s", "30"
    )
    figures.add("  of it, frame taken to light, p95", sorted(total_ms)[1], None, "ms")


def _one_after_another(clip: Path, model: Path) -> float:
    """OpenCV decodes whole frames, resizes and infers, all in one thread."""
    import numpy as np
    import onnxruntime as ort

    options = ort.SessionOptions()
    session = ort.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
    capture = cv2.VideoCapture(str(clip))
    began, frames = time.perf_counter(), 0
    while frames < FRAMES // 3:
        ok, picture = capture.read()
        if not ok:
            break
        small = cv2.resize(picture, (416, 234))
        padded = np.full((416, 416, 3), 114, np.uint8)
        padded[:234] = small
        rgb = padded[:, :, ::-1].astype(np.float32) / 255
        rgb = (rgb - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
        session.run(None, {"images": rgb.transpose(2, 0, 1)[None].astype(np.float32)})
        frames += 1
    return frames / (time.perf_counter() - began)
