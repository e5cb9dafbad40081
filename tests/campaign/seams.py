"""Faults that only a driver or a library can have, put in at the lowest seam inside the service.

Each is switched by the campaign through the text of the file CAMPAIGN_CONTROL, read at every call.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np

from bikeped.capture.cameras import NetworkSource
from bikeped.detection.detector import DetectionResult, Detector
from bikeped.detection.output_layouts import Candidates
from bikeped.detection.preprocess import Letterbox
from bikeped.errors import DetectorError, FeedbackError
from bikeped.feedback.light import SimulatedLight
from bikeped.types import Colour, Detections, Frame, ImageArray, Kind


def control() -> tuple[str, float]:
    """What is asked for now, and its number: `stall 0.7` is ("stall", 0.7)."""
    try:
        word, _, number = Path(os.environ["CAMPAIGN_CONTROL"]).read_text().partition(" ")
    except OSError:
        return "", 0.0
    return word, float(number or 0)


def camera() -> None:
    """The camera's driver: `hang`, `stale` buffers, stamps `future` or `shuffled`."""
    read = NetworkSource.read
    last: dict[int, Frame] = {}

    def faulty(source: NetworkSource) -> Frame:
        word, number = control()
        if word == "hang":
            threading.Event().wait()  # for ever, as a driver may
        frame = read(source)
        if word == "stale":
            return last.setdefault(id(source), frame)
        last[id(source)] = frame
        if word == "future" and frame.number % 50 == 0:
            return dataclasses.replace(frame, captured_s=frame.captured_s + number)
        if word == "shuffled":
            shift_s = (0.0, -0.08, 0.0, -0.02)[frame.number % 4]
            return dataclasses.replace(frame, captured_s=frame.captured_s + shift_s)
        return frame

    NetworkSource.read = faulty  # type: ignore[method-assign]


def detector() -> None:
    """The detector: `raise`, `memory`, `stall` for seconds, `empty` answers, and the network's raw
    output: a `crowd` of so many candidates, before suppression and every cap."""
    infer, began = Detector.infer, list[float]()
    road_users = Detector._road_users

    def crowded(self: Detector, candidates: Candidates, letterbox: Letterbox) -> Detections:
        word, number = control()
        if word == "crowd":
            found = crowd(int(number), *self.input_size)
            class_of = {k: np.flatnonzero(self._kind_of_class == k)[0] for k in (0, 1)}
            class_id = np.where(found.kind == Kind.CYCLIST, class_of[1], class_of[0])
            candidates = Candidates(found.box_px, found.confidence, class_id)
        return road_users(self, candidates, letterbox)

    def faulty(self: Detector, rgb: ImageArray, width: int, height: int) -> DetectionResult:
        word, number = control()
        if word == "raise":
            raise DetectorError("campaign: the runtime failed")
        if word == "memory":
            raise MemoryError("campaign: out of memory")
        if word == "stall":
            time.sleep(number)
        if word == "later-kill":  # once it has answered for so many seconds
            began.append(time.monotonic())
            if time.monotonic() - began[0] > number:
                os.kill(os.getpid(), signal.SIGKILL)
        result = infer(self, rgb, width, height)
        if word == "empty":
            return dataclasses.replace(result, detections=Detections.empty())
        return result

    Detector.infer = faulty  # type: ignore[method-assign]
    Detector._road_users = crowded  # type: ignore[method-assign]


def wall_clock() -> None:
    """`jump` of so many seconds, as `time.time` shows it."""
    now = time.time
    time.time = lambda: now() + (control()[1] if control()[0] == "jump" else 0.0)


def light() -> None:
    """The light's device: `unplugged`."""
    switch = SimulatedLight.set

    def faulty(self: SimulatedLight, colour: Colour) -> None:
        if control()[0] == "unplugged":
            raise FeedbackError("campaign: unplugged")
        switch(self, colour)

    SimulatedLight.set = faulty  # type: ignore[method-assign]


def interpreter() -> None:
    """`hold`: C code that keeps the interpreter's lock for so many seconds, once."""

    def watch() -> None:
        while True:
            time.sleep(0.02)
            word, number = control()
            if word == "hold":
                Path(os.environ["CAMPAIGN_CONTROL"]).unlink()
                import ctypes

                ctypes.PyDLL(None).usleep(int(number * 1e6))

    threading.Thread(target=watch, daemon=True).start()


@functools.cache
def crowd(number: int, width: int, height: int) -> Detections:
    """So many people and cyclists, spread over the ground in the picture."""
    rng = np.random.default_rng(number)
    centre = rng.uniform((0, 0.3 * height), (width, height), (number, 2))
    box = np.hstack([centre, centre]).astype(np.float32) + np.array([-3, -10, 3, 0], np.float32)
    return Detections(
        rng.integers(0, 2, number).astype(np.int8), np.full(number, 0.9, np.float32), box
    )
