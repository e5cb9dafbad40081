"""Draws a scenario as pictures, with the exact box of every road user in them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bikeped.lab.rendering.backdrop import FixtureSprite, backdrop
from bikeped.lab.rendering.compositing import (
    Weather,
    add_glow,
    contact_shadow,
    darken,
    paste_sprite,
)
from bikeped.lab.rendering.conditions import Conditions
from bikeped.lab.rendering.furniture import FOOTPRINT_M, POLE_FOOTPRINT_M
from bikeped.lab.rendering.labels import DrawnObject, Occluder, label
from bikeped.lab.rendering.mesh import Mesh
from bikeped.lab.rendering.people import Appearance, person
from bikeped.lab.rendering.render_camera import SceneCamera
from bikeped.lab.rendering.riders import rider
from bikeped.lab.rendering.sprite import Sprite, rasterise, shadow, sprites_overlap
from bikeped.lab.rendering.vehicles import vehicle
from bikeped.lab.scenarios.scenario import Agent, Scenario
from bikeped.types import FloatArray, ImageArray

_PATH_CLEAR_M = 1.1  #: fixtures nearer than this to an agent's path are left out
_ROUND_LIMBS_PX = 90.0  #: figures smaller than this need no round limbs
_USUAL = Conditions()
#: Share of the light in the middle of the picture below which, at the lens' rim, nothing shows.
_MIN_VIGNETTE = 0.15
Box = tuple[float, float, float, float]  #: u1, v1, u2, v2 in pixels of the picture


@dataclass(frozen=True)
class _SceneItem:
    """An agent, with its `mesh`, or a fixture of the backdrop, without one."""

    occluder: Occluder
    mesh: Mesh | None = None
    size_m: tuple[float, float] = (0.5, 0.5)  #: length and width on the ground


@dataclass(frozen=True)
class _FrameCache:
    """What was drawn at `t_s`."""

    t_s: float
    image: ImageArray
    objects: list[DrawnObject]
    shadows: list[Box]


class ScenePainter:
    """Draws one scenario for one camera and one set of conditions.

    The street is drawn once, and shared by painters of the same camera and conditions; each picture
    adds the agents. The same arguments give the same bytes. Fixtures on an agent's path are left
    out.
    """

    def __init__(
        self, scenario: Scenario, camera: SceneCamera, conditions: Conditions = _USUAL
    ) -> None:
        self.scenario, self.camera, self.conditions = scenario, camera, conditions
        self.backdrop = backdrop(camera, conditions)
        self._weather = Weather(self.backdrop)
        paths = np.concatenate([_resampled(agent.path[:, 1:]) for agent in scenario.agents])
        standing = [
            s for s in self.backdrop.standing if not _blocks_path(s.item.what, s.item.xy_m, paths)
        ]
        standing.sort(key=lambda s: -s.sprite.distance_m)
        self._fixtures = []
        for i, s in enumerate(standing):
            kind = "car" if s.item.what == "car" else None
            place = np.array(s.item.xy_m), s.item.heading_rad
            self._fixtures.append(_SceneItem(Occluder(s.sprite, -1 - i, kind, *place)))
        width, height = camera.size
        self._furniture: list[tuple[str, Box]] = [
            (s.item.what, s.sprite.full_box_px)
            for s in standing
            if s.item.what != "car" and _touches(s.sprite.full_box_px, width, height)
        ]
        self._appearances = {
            agent.id: Appearance.random(np.random.default_rng((conditions.seed, agent.id, 3)))
            for agent in scenario.agents
        }
        self._mask = cv2.merge([self.backdrop.lit.astype(np.uint8) * 255] * 3)
        self._seen = self.backdrop.lit & (self.backdrop.vignette >= _MIN_VIGNETTE)
        self._base = self._with_fixtures(standing)
        self._last: _FrameCache | None = None

    def frame(self, t_s: float) -> ImageArray:
        """The picture [h, w, 3] RGB at `t_s` seconds of the scenario."""
        return self.draw(t_s)[0]

    def objects(self, t_s: float) -> list[DrawnObject]:
        """Visible road users at `t_s`: agents in their order, then parked cars."""
        if self._last is not None and self._last.t_s == t_s:
            return list(self._last.objects)
        return self._labels(self._present(t_s))

    def furniture(self) -> list[tuple[str, Box]]:
        """Fixtures in the picture (`Fixture.what`: lamp, sign, tree, bollard and the like) and the
        box u1, v1, u2, v2 of each whole silhouette, hidden or not."""
        return list(self._furniture)

    def shadows(self, t_s: float) -> list[Box]:
        """Boxes of the agents' cast shadows at `t_s`; none without sun."""
        return list(self._frame(t_s).shadows)

    def draw(self, t_s: float) -> tuple[ImageArray, list[DrawnObject]]:
        """Picture and objects at once."""
        cached = self._frame(t_s)
        return cached.image.copy(), list(cached.objects)

    def _frame(self, t_s: float) -> _FrameCache:
        if self._last is None or self._last.t_s != t_s:
            shown = self._present(t_s)
            image, shadows = self._picture(shown, t_s)
            self._last = _FrameCache(t_s, image, self._labels(shown), shadows)
        return self._last

    def _present(self, t: float) -> list[_SceneItem]:
        """Everything that may hide or be hidden, far ones first."""
        found = list(self._fixtures)
        for agent in self.scenario.agents:
            state = agent.at(t)
            if state is None:
                continue
            xy, heading = state
            away = float(np.hypot(*(xy - self.camera.eye_m[:2])))
            mesh = self._mesh(agent, t, away).placed(xy, heading)
            light, local = self.backdrop.light, self.backdrop.lamplight(xy)
            sprite = rasterise(mesh, self.camera, light, local=local, distance_m=away)
            if sprite is not None:
                occluder = Occluder(sprite, agent.id, agent.kind, xy, heading)
                found.append(_SceneItem(occluder, mesh, agent.size_m[:2]))
        found.sort(key=lambda item: -item.occluder.sprite.distance_m)
        return found

    def _mesh(self, agent: Agent, t: float, distance_m: float) -> Mesh:
        appearance = self._appearances[agent.id]
        tall_px = agent.size_m[2] * self.camera.focal_px / max(distance_m, 1.0)
        sides = 5 if tall_px < _ROUND_LIMBS_PX else 8
        way, moving = _travel(agent, t)
        number = (self.conditions.seed * 31 + agent.id * 7) % 1000
        if agent.kind == "pedestrian":
            return person(agent.size_m, appearance, way, moving, sides)
        if agent.kind in {"cyclist", "motorcycle"}:
            return rider(agent.kind, agent.size_m, appearance, number, way, sides)
        return vehicle(agent.kind, agent.size_m, number)

    def _picture(self, shown: list[_SceneItem], t: float) -> tuple[ImageArray, list[Box]]:
        image = self._base.copy()
        shadows = []
        agents = [(item.mesh, item) for item in shown if item.mesh is not None]
        for mesh, item in agents:
            spot = item.occluder
            box = self._shade(image, mesh, spot.xy_m, item.size_m, spot.heading_rad)
            if box is not None:
                shadows.append(box)
        drawn: list[Sprite] = []
        for item in shown:
            sprite = item.occluder.sprite
            # Fixtures are in the picture already, and drawn again over the agents behind them.
            if item.mesh is not None or any(sprites_overlap(sprite, other) for other in drawn):
                paste_sprite(image, self.backdrop, sprite)
                drawn.append(sprite)
        if self.backdrop.light.lamps:
            for mesh, item in agents:
                add_glow(image, self.backdrop, mesh.lamps, item.occluder.xy_m)
        self._weather.apply(image, t)
        cv2.bitwise_and(image, self._mask, dst=image)
        return image, shadows

    def _with_fixtures(self, standing: list[FixtureSprite]) -> ImageArray:
        """The street with its fixtures; `standing` far ones first."""
        image = self.backdrop.image.copy()
        for item in standing:
            size = FOOTPRINT_M.get(item.item.what, POLE_FOOTPRINT_M)
            self._shade(image, item.mesh, np.array(item.item.xy_m), size, item.item.heading_rad)
        for item in standing:
            paste_sprite(image, self.backdrop, item.sprite)
        if self.backdrop.light.lamps:
            for item in standing:
                if item.item.what == "lamp":
                    add_glow(image, self.backdrop, item.mesh.lamps, None)
        cv2.bitwise_and(image, self._mask, dst=image)
        return image

    def _shade(
        self,
        image: ImageArray,
        mesh: Mesh,
        xy: FloatArray,
        size_m: tuple[float, float],
        heading: float,
    ) -> Box | None:
        """Draws the shadow cast by the sun, whose box is returned, and the soft contact shadow."""
        light = self.backdrop.light
        box = None
        if light.sun.any():
            softness = 1 if self.camera.size[0] < 1200 else 2
            cast = shadow(mesh.quads, self.camera, light.to_sun, softness)
            if cast is not None:
                darken(image, *cast, light.shade)
                left, top, cover = cast
                box = (left, top, left + cover.shape[1], top + cover.shape[0])
        patch = contact_shadow(self.camera, xy, size_m, heading)
        if patch is not None:
            darken(image, *patch, np.array([0.6, 0.6, 0.62]))
        return box

    def _labels(self, shown: list[_SceneItem]) -> list[DrawnObject]:
        occluders = [item.occluder for item in shown]
        found = label(occluders, self._seen, self.camera.pose, self.camera.size)
        order = {agent.id: i for i, agent in enumerate(self.scenario.agents)}
        return sorted(found, key=lambda o: order[o.id] if o.id >= 0 else len(order) - o.id)


def _touches(box: Box, width: int, height: int) -> bool:
    return box[0] < width and box[1] < height and box[2] > 0 and box[3] > 0


def _travel(agent: Agent, t: float) -> tuple[float, bool]:
    """Distance travelled since the start, metres, and whether the agent is moving at `t`."""
    times = agent.path[:, 0]
    steps = np.hypot(*np.diff(agent.path[:, 1:], axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    segment = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(steps) - 1))
    speed = steps[segment] / (times[segment + 1] - times[segment])
    return float(np.interp(t, times, way)), bool(speed > 0.1)


def _resampled(path: FloatArray) -> FloatArray:
    """The path [n, 2] with a point at least every 0.5 m; a long one less densely."""
    ends = np.cumsum(np.concatenate([[0.0], np.hypot(*np.diff(path, axis=0).T)]))
    count = int(min(max(ends[-1] / 0.5, 1), 2000)) + 1
    along = np.linspace(0, ends[-1], count)
    return np.stack([np.interp(along, ends, path[:, i]) for i in (0, 1)], axis=1)


def _blocks_path(what: str, xy: tuple[float, float], paths: FloatArray) -> bool:
    """Whether an agent's path leads through this fixture."""
    apart = np.abs(paths - np.array(xy))
    if what == "car":
        return bool((apart < np.array([2.4, 0.95]) + _PATH_CLEAR_M).all(axis=1).any())
    return bool((np.hypot(*apart.T) < _PATH_CLEAR_M).any())
