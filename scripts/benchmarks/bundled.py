"""The whole loop from a 1080p MJPEG recording with the bundled model, against one after another."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

if TYPE_CHECKING:
    from benchmarks.figures import Figures

FRAMES, DISTINCT = 240, 24


def run(figures: Figures) -> None:
    """Frames a second on this machine's cores, recording on disk to decision."""
    from bikeped.config import load_config
    from bikeped.lab.rendering import ScenePainter, scene_camera
    from bikeped.lab.rendering.avi_writer import AviWriter
    from bikeped.lab.rendering.clip import encode_jpeg
    from bikeped.lab.scenarios.scenario import bundled_folder, load_scenario
    from bikeped.models import BUNDLED_FILE
    from bikeped.pipeline.replay import replay

    # As `bikeped replay` has it: two copies of the model share the cores.
    loaded = load_config(None, ("detection.model=bundled", "detection.providers=[cpu]"))
    in_float = load_config(None, (f"detection.model={BUNDLED_FILE}", "detection.providers=[cpu]"))
    scenario = load_scenario(bundled_folder() / "dense-pedestrian-group.yaml")
    painter = ScenePainter(scenario, scene_camera(loaded, (1920, 1080)))
    pictures = [encode_jpeg(painter.draw(2 + i / 8)[0], 88) for i in range(DISTINCT)]
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "1080p.avi"
        with AviWriter(clip, 30, (1920, 1080)) as writer:
            for i in range(FRAMES):
                writer.write(pictures[i % DISTINCT])
        ours, obvious, int8_ms, float_ms = [], [], [], []
        for _ in range(3):
            result = replay(loaded, str(clip), own_camera=True, mqtt=False)
            ours.append(result.frames / result.wall_s)
            int8_ms.append(result.times.percentiles()["inference"]["p50"])
            result = replay(in_float, str(clip), own_camera=True, mqtt=False)
            float_ms.append(result.times.percentiles()["inference"]["p50"])
            obvious.append(_one_after_another(clip, BUNDLED_FILE))
    figures.add(
        "1080p MJPEG, bundled model, to decision",
        sorted(ours)[1],
        sorted(obvious)[1],
        "frames/s",
        "30",
    )
    figures.add(
        "  of it, inference, median (obvious: in floating point)",
        sorted(int8_ms)[1],
        sorted(float_ms)[1],
        "ms",
    )


def _one_after_another(clip: Path, model: Path) -> float:
    """OpenCV decodes whole frames, resizes and infers on all of them, all in one thread."""
    import numpy as np
    import onnxruntime as ort

    from bikeped.config.schema import DetectionConfig
    from bikeped.detection import load_detector

    width, height = load_detector(DetectionConfig(model=str(model)), Path()).input_size
    high = width * 1080 // 1920
    above = (height - high) // 2
    session = ort.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    capture = cv2.VideoCapture(str(clip))
    began, frames = time.perf_counter(), 0
    while frames < FRAMES // 3:
        ok, picture = capture.read()
        if not ok:
            break
        padded = np.full((height, width, 3), 114, np.uint8)
        padded[above : above + high] = cv2.resize(picture, (width, high))
        rgb = padded[:, :, ::-1].astype(np.float32) / 255
        session.run(None, {"images": rgb.transpose(2, 0, 1)[None]})
        frames += 1
    return frames / (time.perf_counter() - began)
