"""The tracker of the paper's simulation (definitions, section 7), for reproducing the paper only.

Batched over scenes, with the arrays of `BatchTracker` that a simulation reads. Slots are agents: a
new track takes its agent's id, in place of an older track of that id.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bikeped.tracking.matching import match_greedy
from bikeped.types import BoolArray, FloatArray, IntArray, KindArray

MATCH_RADIUS_M = 3.0
MAX_UNSEEN_FRAMES = 30
#: Of the newest step in velocity and acceleration.
WEIGHT = 0.5


class PaperTracker:
    """Tracks of `scenes` scenes of `agents` agents: `update` once a frame, then read the arrays.

    Arrays are [scenes, agents]; vectors [scenes, agents, 2] in metres and seconds. A *step* is the
    detection minus the predicted place: in steady motion the velocity settles at half of the true
    one. The paper's figures hold only with it.
    """

    def __init__(self, scenes: int, agents: int, fps: float) -> None:
        self._fps = fps
        self.alive: BoolArray = np.zeros((scenes, agents), np.bool_)
        self.id: IntArray = np.tile(np.arange(1, agents + 1), (scenes, 1))
        self.kind: KindArray = np.zeros((scenes, agents), np.int8)
        self.xy_m: FloatArray = np.zeros((scenes, agents, 2))
        self.seen_s: FloatArray = np.zeros((scenes, agents))
        self.parked: BoolArray = np.zeros((scenes, agents), np.bool_)
        # By frame, as the paper has them.
        self._step: FloatArray = np.zeros((scenes, agents, 2))
        self._change: FloatArray = np.zeros((scenes, agents, 2))
        self._unseen: IntArray = np.zeros((scenes, agents), np.int64)

    @property
    def reported(self) -> BoolArray:
        """[scenes, agents]: a track is reported from its first detection on, unseen too."""
        return self.alive

    @property
    def velocity_mps(self) -> FloatArray:
        return self._step * self._fps

    @property
    def acceleration_mps2(self) -> FloatArray:
        return self._change * self._fps**2

    def update(self, time_s: float, xy_m: FloatArray, kind: KindArray) -> None:
        """The detections [scenes, agents, 2] of the next frame; `kind` -1: none of this agent."""
        self.xy_m += np.where(self.alive[..., None], self._step, 0.0)
        detected = kind >= 0
        matched = self._match(xy_m, kind)
        scene, slot = (matched >= 0).nonzero()
        at, by = (scene, slot), (scene, matched[scene, slot])
        step = xy_m[by] - self.xy_m[at]
        change = step - self._step[at]
        self._step[at] += WEIGHT * (step - self._step[at])
        self._change[at] += WEIGHT * (change - self._change[at])
        self.xy_m[at] = xy_m[by]
        self._unseen += 1
        self._unseen[at] = 0
        self.seen_s[at] = time_s
        self.alive &= self._unseen <= MAX_UNSEEN_FRAMES
        detected[by] = False
        self.alive |= detected
        self.kind[detected] = kind[detected]
        self.xy_m[detected] = xy_m[detected]
        self._step[detected] = self._change[detected] = 0.0
        self._unseen[detected] = 0
        self.seen_s[detected] = time_s

    def _match(self, xy_m: FloatArray, kind: KindArray) -> npt.NDArray[np.intp]:
        """Detection of each slot, -1 for none: greedy by distance, within a class."""
        scenes, agents = self.alive.shape
        apart = self.xy_m[:, :, None] - xy_m[:, None]
        cost = (apart**2).sum(-1)
        allowed = (cost <= MATCH_RADIUS_M**2) & (self.kind[:, :, None] == kind[:, None])
        scene, slot, detection = (allowed & self.alive[..., None]).nonzero()
        flat = match_greedy(
            scene * agents + slot,
            scene * agents + detection,
            cost[scene, slot, detection],
            scenes * agents,
            scenes * agents,
        ).reshape(scenes, agents)
        return np.where(flat >= 0, flat - np.arange(scenes)[:, None] * agents, -1)
