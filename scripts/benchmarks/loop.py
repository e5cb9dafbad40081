"""The whole loop from a MJPEG recording to the decision, against one step after another."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort

from benchmarks.figures import Figures
from bikeped.config.load import LoadedConfig, load_config
from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import load_detector
from bikeped.lab.demo.summary import bundled_scenario
from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
from bikeped.lab.rendering.clip import AviWriter, encode_jpeg
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenario
from bikeped.models import BUNDLED_FILE
from bikeped.pipeline.replay import ReplayResult, replay

MODEL = Path(__file__).parents[3] / "shared" / "models" / "yolox_nano.onnx"
FRAMES, DISTINCT = 240, 24


@cache
def street_4k(count: int) -> list[bytes]:
    """`count` frames of the demo's crossing at 3840 x 2160, spread over its length, as JPEG."""
    scenario = load_scenario(bundled_scenario())
    painter = ScenePainter(scenario, scene_camera(load_config(), (3840, 2160)), Conditions())
    step = scenario.duration_s / max(count, 2)
    return [encode_jpeg(painter.frame(i * step + step / 2), 90) for i in range(count)]


def run(figures: Figures) -> None:
    """A 4K recording with a real model, on this machine's cores."""
    if not MODEL.is_file():
        print("loop: left out, for ../shared/models/yolox_nano.onnx is not there")
        return
    settings = [f"detection.model={MODEL}", "detection.threads=1", "detection.providers=[cpu]"]
    mean, spread = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]

    def prepared(picture: np.ndarray) -> np.ndarray:
        rgb = _on_grey(picture, 416, 416, 0)
        return np.asarray((rgb - mean) / spread, np.float32)

    loaded = load_config(overrides=settings)
    (ours,), obvious = _measure([loaded], street_4k(DISTINCT), (3840, 2160), MODEL, prepared)
    figures.add("4K MJPEG recording to decision", _rate(ours), obvious, "frames/s", "30")
    figures.add("  of it, frame taken to light, p95", _time(ours, "total", "p95"), None, "ms")


def bundled(figures: Figures) -> None:
    """A 1080p recording with the bundled model, on this machine's cores."""
    # As `bikeped replay` has it: two copies of the model share the cores.
    int8, in_float = (
        load_config(None, (f"detection.model={model}", "detection.providers=[cpu]"))
        for model in ("bundled", BUNDLED_FILE)
    )
    scenario = load_scenario(bundled_folder() / "dense-pedestrian-group.yaml")
    painter = ScenePainter(scenario, scene_camera(int8, (1920, 1080)))
    pictures = [encode_jpeg(painter.draw(2 + i / 8)[0], 88) for i in range(DISTINCT)]
    width, height = load_detector(DetectionConfig(model=str(BUNDLED_FILE)), Path()).input_size
    (ours, floating), obvious = _measure(
        [int8, in_float],
        pictures,
        (1920, 1080),
        BUNDLED_FILE,
        lambda picture: _on_grey(picture, width, height, (height - width * 1080 // 1920) // 2),
    )
    figures.add("1080p MJPEG, bundled model, to decision", _rate(ours), obvious, "frames/s", "30")
    figures.add(
        "  of it, inference, median (obvious: in floating point)",
        *(_time(results, "inference", "p50") for results in (ours, floating)),
        "ms",
    )


def _measure(
    configs: Sequence[LoadedConfig],
    pictures: Sequence[bytes],
    size: tuple[int, int],
    model: Path,
    prepared: Callable[[np.ndarray], np.ndarray],
) -> tuple[list[list[ReplayResult]], float]:
    """Three replays with each configuration, and the median frames a second of the obvious way.

    Both read the same recording on disk, in turns.
    """
    results: list[list[ReplayResult]] = [[] for _ in configs]
    obvious = []
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clip.avi"
        with AviWriter(clip, 30, size) as writer:
            for i in range(FRAMES):
                writer.write(pictures[i % DISTINCT])
        own = size != (3840, 2160)  # which the configured camera has
        for _ in range(3):
            for loaded, kept in zip(configs, results, strict=True):
                kept.append(replay(loaded, str(clip), own_camera=own, mqtt=False))
            obvious.append(_one_after_another(clip, model, prepared))
    return results, statistics.median(obvious)


def _rate(results: Sequence[ReplayResult]) -> float:
    return statistics.median(result.frames / result.wall_s for result in results)


def _time(results: Sequence[ReplayResult], stage: str, which: str) -> float:
    return statistics.median(result.times.percentiles()[stage][which] for result in results)


def _on_grey(picture: np.ndarray, width: int, height: int, above: int) -> np.ndarray:
    """The picture as wide as the input, on grey, RGB from 0 to 1."""
    high = width * picture.shape[0] // picture.shape[1]
    padded = np.full((height, width, 3), 114, np.uint8)
    padded[above : above + high] = cv2.resize(picture, (width, high))
    return padded[:, :, ::-1].astype(np.float32) / 255


def _one_after_another(
    clip: Path, model: Path, prepared: Callable[[np.ndarray], np.ndarray]
) -> float:
    """OpenCV decodes whole frames, resizes and infers on all of them, all in one thread."""
    session = ort.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    capture = cv2.VideoCapture(str(clip))
    began, frames = time.perf_counter(), 0
    while frames < FRAMES // 3:
        ok, picture = capture.read()
        if not ok:
            break
        session.run(None, {"images": prepared(picture).transpose(2, 0, 1)[None]})
        frames += 1
    return frames / (time.perf_counter() - began)
