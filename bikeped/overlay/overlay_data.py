"""What a picture of one frame shows, and the projection from the ground into the picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bikeped.faults import fault_texts
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.overlay.drawing import SIGNAL_COLOUR, Rgb
from bikeped.types import Decision, Detections, FloatArray, Signal, State, Tracks

#: Camera ground positions [n, 2] in metres to frame pixels [n, 2]; NaN where the lens cannot see.
GroundToFrame = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class OverlayData:
    """One frame's results. `history` maps a track id to its last positions [n, 2], oldest first."""

    detections: Detections
    tracks: Tracks
    decision: Decision
    frame_number: int
    time_s: float  #: since the start, as shown
    signal: Signal | None = None  #: None: shown as the decision's state
    latency_s: float | None = None  #: capture to decision
    clock: str = ""  #: date and time of day, when known
    history: Mapping[int, FloatArray] = field(default_factory=dict)

    @property
    def shown_name(self) -> str:
        """IDLE, SAFE, WARNING, ALERT, FAULT or OFF: what the road user sees."""
        return self.decision.state.name if self.signal is None else self.signal.name

    @property
    def sentence(self) -> str:
        """Why, in one line: the faults when the light is FAULT, else the decision's sentence."""
        if self.shown_name == "FAULT" and self.signal is not None and self.signal.faults:
            return "; ".join(fault_texts(self.signal.faults))
        return self.decision.sentence

    @property
    def alerting(self) -> bool:
        """Whether to highlight the decision's pair."""
        return self.decision.state is State.ALERT and self.shown_name != "FAULT"

    @property
    def pair_colour(self) -> Rgb:
        """Colour of the decision's pair."""
        return SIGNAL_COLOUR["ALERT" if self.alerting else "WARNING"]

    def pair_rows(self) -> tuple[int, int] | None:
        """Rows of the decision's cyclist and pedestrian in `tracks`; None when either is gone."""
        pair = self.decision.pair
        if pair is None:
            return None
        cyclist = np.flatnonzero(self.tracks.id == pair.cyclist_id)
        pedestrian = np.flatnonzero(self.tracks.id == pair.pedestrian_id)
        if len(cyclist) == 0 or len(pedestrian) == 0:
            return None
        return int(cyclist[0]), int(pedestrian[0])


def ground_projector(camera: GroundCamera, framing: Framing) -> GroundToFrame:
    """From camera ground metres to pixels of frames with this framing.

    Points beside the sensor still get a pixel, so that a line may run off the edge of the picture;
    points behind the lens get NaN.
    """
    unbounded = replace(camera, window_px=None)

    def project(xy_m: FloatArray) -> FloatArray:
        uv, seen = unbounded.project(xy_m)
        return np.where(seen[..., None], framing.crop_to_frame(uv), np.nan)

    return project
