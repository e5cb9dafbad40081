"""What to draw of a frame's result, for the overlay video and the live page."""

from __future__ import annotations

import numpy as np

from bikeped.overlay import GroundToFrame, OverlayData, ground_projector
from bikeped.pipeline.frame_result import FrameResult
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.types import Signal


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
