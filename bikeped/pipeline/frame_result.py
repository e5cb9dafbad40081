"""The result of one frame: its latencies, and what to draw of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bikeped.detection.base import DetectionResult
from bikeped.overlay import GroundToFrame, OverlayData, ground_projector
from bikeped.pipeline.detection_scheduler import DecodedFrame
from bikeped.pipeline.track_and_decide import TrackAndDecide, TrackingResult
from bikeped.types import Detections, Signal


@dataclass(frozen=True)
class FrameResult:
    """One frame on its whole way; `t_s` is its capture time since the first result."""

    decoded: DecodedFrame
    t_s: float
    detections: Detections
    tracking: TrackingResult
    signal: Signal
    latency_ms: dict[str, float]  #: by stage, with `total` and `capture_age`


class FrameResultListener(Protocol):
    """Takes frame results: telemetry, audit log, event file, overlay."""

    async def on_frame_result(self, result: FrameResult) -> None:
        """One frame's result. On a live feed it is only queued: the loop waits for this."""


def stage_latencies(
    decoded: DecodedFrame,
    answer: DetectionResult,
    tracking: TrackingResult,
    feedback_ms: float,
    total_ms: float | None,
) -> dict[str, float]:
    """Milliseconds by stage: the paper's, `acquire`, their `total`, and `capture_age`.

    `total_ms` is measured from taking the frame over to setting the light; None sums the stages,
    as for a recording: it is decoded ahead, as no camera could be, and waiting is no latency.
    """
    stages = {
        "pre": decoded.decode_ms + answer.pre_ms,
        "inference": answer.inference_ms,
        "post": answer.post_ms,
        "track": tracking.track_ms,
        "decide": tracking.decide_ms,
        "feedback": feedback_ms,
    }
    total_ms = sum(stages.values()) if total_ms is None else total_ms
    return {
        "acquire": decoded.acquire_ms,
        **stages,
        "total": total_ms,
        "capture_age": total_ms + decoded.acquire_ms,
    }


def frame_overlay(
    result: FrameResult, track_and_decide: TrackAndDecide, signal: Signal | None = None
) -> tuple[OverlayData, GroundToFrame]:
    """The data to draw, and the projection of ground points into the frame.

    `signal` None: shown as the decision's state. Call it on the event loop: the tracker's history
    changes with the next frame.
    """
    frame, tracking = result.decoded.frame, result.tracking
    data = OverlayData(
        detections=result.detections,
        tracks=tracking.tracks,
        decision=tracking.decision,
        frame_number=frame.number,
        time_s=result.t_s,
        signal=signal,
        latency_s=result.latency_ms["total"] / 1e3,
        history={key: np.asarray(xy) for key, xy in track_and_decide.tracker.history().items()},
    )
    mapper = track_and_decide.ground_mapper
    return data, ground_projector(mapper.camera, mapper.framing_for(frame.width, frame.height))
