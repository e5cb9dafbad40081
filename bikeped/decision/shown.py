"""What the light shows of the rule's states (definitions, section 14). Pure.

The rule's state of a frame is *raw*; one frame of it is often a detector's mistake. ALERT is shown
when the rule said so in at least `on_frames` of the frames of the last `window_s`, and is then held
for `hold_s` after the last raw ALERT, so that the light does not flicker.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bikeped.decision.track_rows import EPSILON_S
from bikeped.types import BoolArray, State

_ALERT, _WARNING = int(State.ALERT), int(State.WARNING)


@dataclass(frozen=True)
class ShownSettings:
    """When ALERT is shown. The defaults are 2 of 3 frames at 30 frames/s, and 1.5 s.

    Frames younger than `window_s` count; half a frame is left for the camera's jitter.
    """

    on_frames: int = 2
    window_s: float = 2.5 / 30
    hold_s: float = 1.5


#: The raw state is shown as it is: the paper's simulation.
AS_RAW = ShownSettings(on_frames=1, hold_s=0.0)


class ShownAlert:
    """Follows the raw state of one crossing, frame by frame."""

    def __init__(self, settings: ShownSettings) -> None:
        self.settings = settings
        self.on = False  #: ALERT is shown
        self._alert_s = -math.inf  # time of the last raw ALERT
        self._recent: deque[tuple[float, bool]] = deque()

    def update(self, time_s: float, raw: bool) -> bool:
        """Whether ALERT is shown at `time_s`, s, in which the rule says ALERT or not (`raw`).

        Where fewer than `on_frames` frames came within the window, as from a slow camera, all of
        them must be ALERT. Times increase.
        """
        recent = self._recent
        recent.append((time_s, raw))
        while recent[0][0] < time_s - self.settings.window_s:
            recent.popleft()
        self.on &= time_s - self._alert_s <= self.settings.hold_s + EPSILON_S
        if raw:
            self._alert_s = time_s
            if not self.on:
                alerts = sum(alert for _, alert in recent)
                self.on = alerts >= min(self.settings.on_frames, len(recent))
        return self.on


def shown_alert(
    time_s: npt.NDArray[np.float64],
    raw: BoolArray,
    settings: ShownSettings,
    scene_start: Sequence[int] | npt.NDArray[np.int64] = (0,),
) -> BoolArray:
    """Frames [f] in which ALERT is shown, from those in which the rule says ALERT.

    `time_s` [f]; `scene_start` lists the first frame of each independent scene, 0 included.
    """
    shown: BoolArray = np.zeros(len(raw), np.bool_)
    starts = np.append(scene_start, len(raw)).tolist()
    for begin, end in itertools.pairwise(starts):
        alert = ShownAlert(settings)
        frames = zip(time_s[begin:end].tolist(), raw[begin:end].tolist(), strict=True)
        shown[begin:end] = [alert.update(at_s, on) for at_s, on in frames]
    return shown


def shown_states(raw: npt.NDArray[np.int8], shown: BoolArray) -> npt.NDArray[np.int8]:
    """State codes [f] that the light shows: a raw ALERT that is not shown yet is a WARNING."""
    calm = np.where(raw == _ALERT, _WARNING, raw)
    return np.where(shown, _ALERT, calm).astype(np.int8)
