"""Watches the detector: gives it pictures with known answers, and looks for motion that it ignores.

The check picture is the site's (`detection.check_picture`), a drawn one for the bundled model, or
else a frame in which the model was confident. That frame stays in memory only. Motion is looked for
in a thread of its own.
"""

from __future__ import annotations

import asyncio
import logging

import numpy as np

from bikeped.config.build import framing
from bikeped.config.load import LoadedConfig
from bikeped.detection.detector import DetectionResult
from bikeped.errors import ConfigError
from bikeped.faults import Fault
from bikeped.geometry.camera import GroundCamera
from bikeped.models import BUNDLED
from bikeped.monitor.detector_check import DetectorCheck, DetectorNumbers, finds_again
from bikeped.monitor.road_motion import RoadMotion
from bikeped.monitor.verdicts import Verdict
from bikeped.pipeline.check_picture import (
    CheckPicture,
    drawn_check_picture,
    known_answers,
    read_check_picture,
)
from bikeped.pipeline.detection_scheduler import DecodedFrame, DetectorPool, FrameDetector
from bikeped.pipeline.runtime import RateLimitedLogger, WorkerThread
from bikeped.types import Detections, Frame, Kind

log = logging.getLogger(__name__)

_RENEW_S = 600.0  #: a remembered frame is replaced by a newer one after this


class DetectorWatch:
    """Watches `detector` on the frames of `camera`; `live`: they do not wait for it.

    ConfigError where `detection.check_picture` cannot be used.
    """

    def __init__(
        self, loaded: LoadedConfig, detector: FrameDetector, camera: GroundCamera, live: bool
    ) -> None:
        config = loaded.config
        self._detector, self._live = detector, live
        self._check = DetectorCheck()
        self._motion = RoadMotion(camera, framing(loaded), config.decision.max_range_m)
        self._moved = (0.0, 0)
        self._worker = WorkerThread("motion")
        self._look: asyncio.Future[tuple[float, int]] | None = None
        self._limited_log = RateLimitedLogger(log)
        self._threshold = config.detection.confidence
        bundled = config.detection.model == BUNDLED
        self._draws_for = detector if bundled and isinstance(detector, DetectorPool) else None
        self._picture = self._configured(loaded)
        self._remembers = self._picture is None and self._draws_for is None

    def _configured(self, loaded: LoadedConfig) -> CheckPicture | None:
        name, camera = loaded.config.detection.check_picture, loaded.config.camera
        if name is None:
            return None
        picture, model_sha256 = read_check_picture(loaded.path(name))
        wrong_px = picture.frame.height * camera.width / picture.frame.width - camera.height
        if abs(wrong_px) > camera.width / picture.frame.width + 1:
            raise ConfigError(
                f"{loaded.source}: detection.check_picture: {name} has other proportions than "
                "camera.width and camera.height; make it again with bikeped align --check-picture"
            )
        if model_sha256 == self._detector.model_hash:
            return picture
        log.warning(
            "detection.check_picture: %s is another model's and is not used; make it again with "
            "bikeped align --check-picture",
            name,
        )
        return None

    async def close(self) -> None:
        """Ends the thread."""
        await self._worker.close()

    async def on_answer(self, decoded: DecodedFrame, found: Detections) -> None:
        """What the detector found in a frame, in the frames' order."""
        frame = decoded.frame
        time_s = frame.captured_s
        self._take_motion()
        if self._look is None and self._motion.due(time_s):
            self._look = self._worker.submit(self._motion.update, decoded.rgb, time_s)
            if not self._live:  # the same in every replay
                await asyncio.wait({self._look})
                self._take_motion()
        self._check.answered(len(found), time_s, *self._moved)
        if self._picture is None and (pool := self._draws_for) is not None:
            size = frame.width, frame.height
            self._picture = drawn_check_picture(size, pool.decode_size(*size), pool.region)
        elif self._remembers and len(found) and self._check.trusted:
            self._remember(decoded, known_answers(found, self._threshold))

    def _take_motion(self) -> None:
        if self._look is None or not self._look.done():
            return
        error = self._look.exception()
        if error is None:
            self._moved = self._look.result()
        else:
            self._limited_log.failure("motion", error)
        self._look = None

    def _remember(self, decoded: DecodedFrame, known: Detections) -> None:
        """Keeps the frame where it is the first, the newer, or the first with a person."""
        if not len(known):
            return
        if self._picture is not None:
            age_s = decoded.frame.captured_s - self._picture.frame.captured_s
            of_people = bool((known.kind != Kind.VEHICLE).any())
            had_people = bool((self._picture.known.kind != Kind.VEHICLE).any())
            if not (of_people and (not had_people or not 0 <= age_s < _RENEW_S)):
                return
        rgb, f = np.array(decoded.rgb), decoded.frame
        frame = Frame(f.number, f.captured_s, f.width, f.height, rgb=rgb)
        self._picture = CheckPicture(frame, rgb, known)

    def check_picture(self, waits_s: float) -> DecodedFrame | None:
        """See `DetectorChecker`."""
        if self._picture is None or not self._check.due(waits_s):
            return None
        self._checked_with = self._picture
        return DecodedFrame(self._picture.frame, self._picture.rgb, 0.0, 0.0, 0.0)

    def checked(self, answer: DetectionResult | None) -> None:
        """See `DetectorChecker`."""
        known = self._checked_with.known
        self._check.checked(answer is not None and finds_again(known, answer.detections))

    @property
    def fault(self) -> Fault | None:
        """`detector.blind`, while the model is."""
        return self._check.fault

    @property
    def verdict(self) -> Verdict:
        """What the fault is judged by."""
        return self._check.verdict

    @property
    def numbers(self) -> DetectorNumbers:
        """The numbers for health and metrics."""
        return self._check.numbers
