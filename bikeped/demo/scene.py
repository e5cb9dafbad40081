"""Scenarios as fisheye pictures, with the exact box of every road user.

What is drawn goes through the very GroundCamera that later puts boxes on the ground, so the whole
way from pixel to metre is exercised. Not drawn: occlusion of boxes (a box is that of the whole
object even when another stands before it), weather, darkness, lens flare.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from bikeped.conformance.scenario import Agent, Scenario
from bikeped.demo.actors import body
from bikeped.demo.pen import Eye, paint, shadow
from bikeped.demo.street import background
from bikeped.geometry import CameraPose, Framing, GroundCamera
from bikeped.types import FloatArray, ImageArray


@dataclass(frozen=True)
class DrawnObject:
    """One road user in one frame.

    `box_px`: u1, v1, u2, v2 in frame pixels, clipped to the frame. `xy_m`: its true ground centre
    in the camera ground frame; `world_m` in the world.
    """

    id: int
    kind: str
    box_px: tuple[float, float, float, float]
    xy_m: tuple[float, float]
    world_m: tuple[float, float]


class Scene:
    """Draws one scenario for one camera at one frame size; the street only once, at the start."""

    def __init__(
        self,
        scenario: Scenario,
        camera: GroundCamera,
        framing: Framing,
        pose: CameraPose,
        size: tuple[int, int] = (1920, 1080),
    ) -> None:
        """`framing` is the sensor's; `size` (width, height) is any scaled copy of the sensor image.

        Raises GeometryError when `size` has other proportions than the sensor.
        """
        self.scenario, self.size = scenario, size
        self.eye = Eye(camera, pose, framing.for_frame(*size))
        self._street, self._lit = background(self.eye, *size)

    def objects(self, t: float) -> list[DrawnObject]:
        """Who is (at least partly) in the picture at `t` seconds, in the scenario's order."""
        found = []
        for agent in self.scenario.agents:
            state = agent.at(t)
            if state is None:
                continue
            box = self._box(_corners(agent, *state))
            if box is not None:
                ground = self.eye.pose.world_to_ground(state[0])
                found.append(
                    DrawnObject(
                        agent.id,
                        agent.kind,
                        box,
                        (float(ground[0]), float(ground[1])),
                        (float(state[0][0]), float(state[0][1])),
                    )
                )
        return found

    def frame(self, t: float, without: Collection[int] = ()) -> ImageArray:
        """The picture [h, w, 3] RGB at `t` seconds; agents with an id in `without` are left out."""
        image = self._street.copy()
        eye = self.eye.position
        present: list[tuple[float, Agent, FloatArray, float]] = []
        for agent in self.scenario.agents:
            state = agent.at(t)
            if state is not None and agent.id not in without:
                away = float(np.hypot(*(state[0] - eye[:2])))
                present.append((away, agent, *state))
        for _, agent, xy, heading in sorted(present, key=lambda item: -item[0]):
            corners = _corners(agent, xy, heading)
            if self._box(corners) is None:
                continue
            shadow(image, self.eye.pixels(_footprint(corners)), 0.42)
            parts = body(agent.kind, agent.id, agent.size_m, xy, heading, _travelled(agent, t), eye)
            paint(image, self.eye, parts)
        image[~self._lit] = 0
        return image

    def _box(self, corners: FloatArray) -> tuple[float, float, float, float] | None:
        """Tightest upright rectangle of the visible corners, clipped to the frame.

        Corners that the lens sees beside the sensor count too: an object cut off by the frame's
        edge keeps the part inside, as a detector's box would.
        """
        pixels = self.eye.pixels(corners)
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        if len(pixels) == 0:
            return None
        # The frame ends where the crop does when the crop is narrower than the sensor.
        u0, v0, u1, v1 = self._window()
        low = np.maximum(pixels.min(axis=0), (u0, v0))
        high = np.minimum(pixels.max(axis=0), (u1, v1))
        if (high - low <= 1.0).any():
            return None
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def _window(self) -> tuple[float, float, float, float]:
        framing = self.eye.framing
        low = framing.crop_to_frame(np.array(framing.window_px[:2]))
        high = framing.crop_to_frame(np.array(framing.window_px[2:]))
        return (
            max(float(low[0]), 0.0),
            max(float(low[1]), 0.0),
            min(float(high[0]), float(self.size[0])),
            min(float(high[1]), float(self.size[1])),
        )


def _corners(agent: Agent, xy: FloatArray, heading: float) -> FloatArray:
    """The 8 corners [8, 3] of the agent's box in the world; the lower four come first."""
    length, width, height = agent.size_m
    c, s = np.cos(heading), np.sin(heading)
    flat = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (length / 2, width / 2)
    turned = flat @ np.array([[c, s], [-s, c]]) + xy
    return np.concatenate([np.column_stack([turned, np.full(4, z)]) for z in (0.0, height)], axis=0)


def _footprint(corners: FloatArray) -> FloatArray:
    """An ellipse [24, 3] inside the box's lower face: the shadow right below the object."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    centre = corners[:4].mean(axis=0)
    along, across = (corners[0] - corners[3]) / 2, (corners[0] - corners[1]) / 2
    ring: FloatArray = (
        centre + 0.94 * np.cos(turn)[:, None] * across + 0.94 * np.sin(turn)[:, None] * along
    )
    return ring


def _travelled(agent: Agent, t: float) -> float:
    """Metres that the agent has covered since its start."""
    times = agent.path[:, 0]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(agent.path[:, 1:], axis=0).T))])
    return float(np.interp(t, times, way))
