"""Scenarios as pictures, with the exact box of everybody in them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bikeped.conformance.scenario import Agent, Scenario
from bikeped.scene.backdrop import Backdrop, backdrop
from bikeped.scene.camera import SceneCamera
from bikeped.scene.conditions import Conditions
from bikeped.scene.mesh import Mesh
from bikeped.scene.people import Looks, person
from bikeped.scene.riders import rider
from bikeped.scene.sprite import Sprite, halo, inside, rasterise, shadow
from bikeped.scene.vehicles import vehicle
from bikeped.scene.weather import Weather
from bikeped.types import Float32Array, FloatArray, ImageArray, Kind

#: What each kind of agent counts as: the default configuration's classes.
KINDS: dict[str, Kind] = {
    "pedestrian": Kind.PEDESTRIAN,
    "cyclist": Kind.CYCLIST,
    "motorcycle": Kind.CYCLIST,
    "car": Kind.VEHICLE,
    "bus": Kind.VEHICLE,
    "truck": Kind.VEHICLE,
}
_PATH_CLEAR_M = 1.1  #: fixtures nearer than this to somebody's path are left out
_MIN_PX = 1.5  #: smaller than this on a side is not in the picture


@dataclass(frozen=True)
class DrawnObject:
    """One road user in one picture.

    `id` is the agent's; parked cars of the place have negative ones. `box_px`: u1, v1, u2, v2 of
    the visible silhouette in pixels of the picture, from its edges; `full_box_px`: of the whole
    silhouette, which may reach beyond the picture. `visible`: share of the silhouette that is
    neither hidden nor outside the picture. `xy_m`: true ground centre in the camera ground frame,
    `world_m` in the world; `heading_rad` counter-clockwise from east.
    """

    id: int
    kind: str
    label: Kind
    box_px: tuple[float, float, float, float]
    full_box_px: tuple[float, float, float, float]
    visible: float
    xy_m: tuple[float, float]
    world_m: tuple[float, float]
    heading_rad: float

    @property
    def distance_m(self) -> float:
        """Along the ground from below the lens."""
        return float(np.hypot(*self.xy_m))


@dataclass(eq=False)
class _Shown:
    """A sprite in a picture and what is still to be seen of it."""

    sprite: Sprite
    left: Float32Array | None  #: coverage that nobody nearer hides, [h, w] in 0..1; None: fixture
    agent: Agent | None = None
    fixed_id: int = 0
    xy: FloatArray | None = None
    heading: float = 0.0


class ScenePainter:
    """Draws one scenario for one camera and one set of conditions.

    The street is drawn once (and shared by painters of the same camera and conditions); a picture
    draws who moves. The same arguments give the same bytes.
    """

    def __init__(
        self, scenario: Scenario, camera: SceneCamera, conditions: Conditions = Conditions()
    ) -> None:
        self.scenario, self.camera, self.conditions = scenario, camera, conditions
        self.backdrop: Backdrop = backdrop(camera, conditions)
        self._weather = Weather(self.backdrop)
        paths = np.concatenate([_dense(agent.path[:, 1:]) for agent in scenario.agents])
        self._standing = [
            s
            for s in self.backdrop.standing
            if s.sprite is not None and not _in_the_way(s.item.what, s.item.xy_m, paths)
        ]
        self._looks = {
            agent.id: Looks.of(np.random.default_rng((conditions.seed, agent.id, 3)))
            for agent in scenario.agents
        }
        self._base = self._with_fixtures()
        self._mask = cv2.merge([self.backdrop.lit.astype(np.uint8) * 255] * 3)
        self._last: tuple[float, ImageArray, list[DrawnObject]] | None = None

    def frame(self, t_s: float) -> ImageArray:
        """The picture [h, w, 3] RGB at `t_s` seconds of the scenario."""
        return self.draw(t_s)[0]

    def objects(self, t_s: float) -> list[DrawnObject]:
        """Everybody of whom something is to be seen at `t_s`: agents first, in their order."""
        if self._last is not None and self._last[0] == t_s:
            return list(self._last[2])
        return self._labels(self._present(t_s))

    def draw(self, t_s: float) -> tuple[ImageArray, list[DrawnObject]]:
        """Picture and objects at once."""
        if self._last is not None and self._last[0] == t_s:
            return self._last[1].copy(), list(self._last[2])
        shown = self._present(t_s)
        image = self._base.copy()
        for item, mesh in shown:
            if mesh is not None:
                self._cast(image, item, mesh)
        for item, mesh in shown:
            if mesh is not None:
                self._paste(image, item.sprite, None)
            elif any(m is not None and _touch(item.sprite, other.sprite) for other, m in shown):
                self._paste(image, item.sprite, None)
        if self.backdrop.light.lamps:
            for item, mesh in shown:
                if mesh is not None:
                    self._shine(image, mesh, item)
        self._weather.apply(image, t_s)
        cv2.bitwise_and(image, self._mask, dst=image)
        objects = self._labels(shown)
        self._last = (t_s, image, objects)
        return image.copy(), list(objects)

    # -- who is there -----------------------------------------------------------------------

    def _present(self, t: float) -> list[tuple[_Shown, Mesh | None]]:
        """Everything that may hide or be hidden, far ones first; fixtures without a mesh."""
        eye = self.camera.eye_m[:2]
        found: list[tuple[_Shown, Mesh | None]] = []
        for agent in self.scenario.agents:
            state = agent.at(t)
            if state is None:
                continue
            xy, heading = state
            away = float(np.hypot(*(xy - eye)))
            mesh = self._mesh(agent, t, away).placed(xy, heading)
            sprite = rasterise(
                mesh,
                self.camera,
                self.backdrop.light,
                local=self.backdrop.lamplight(xy),
                away_m=away,
            )
            if sprite is not None:
                found.append((_Shown(sprite, _share(sprite), agent, agent.id, xy, heading), mesh))
        for number, item in enumerate(self._standing):
            assert item.sprite is not None
            car = item.item.what == "car"
            shown = _Shown(
                item.sprite,
                _share(item.sprite) if car else None,
                None,
                -1 - number,
                np.array(item.item.xy_m),
                item.item.heading_rad,
            )
            found.append((shown, None))
        found.sort(key=lambda pair: -pair[0].sprite.away_m)
        return found

    def _mesh(self, agent: Agent, t: float, away_m: float) -> Mesh:
        looks = self._looks[agent.id]
        # Far figures need no round limbs.
        tall_px = agent.size_m[2] * self.camera.focal_px / max(away_m, 1.0)
        sides = 5 if tall_px < 90 else 8
        way, moving = _travelled(agent, t)
        number = (self.conditions.seed * 31 + agent.id * 7) % 1000
        if agent.kind == "pedestrian":
            return person(agent.size_m, looks, way, moving, sides)
        if agent.kind in {"cyclist", "motorcycle"}:
            return rider(agent.kind, agent.size_m, looks, number, way, sides)
        return vehicle(agent.kind, agent.size_m, number)

    # -- pixels -----------------------------------------------------------------------------

    def _with_fixtures(self) -> ImageArray:
        """The street with everything that stands on it."""
        image = self.backdrop.image.copy()
        ordered = sorted(self._standing, key=lambda s: -(s.sprite.away_m if s.sprite else 0))
        for item in ordered:
            self._shadow(image, item.mesh, np.array(item.item.xy_m), (0.5, 0.5))
        for item in ordered:
            assert item.sprite is not None
            self._paste(image, item.sprite, None)
        if self.backdrop.light.lamps:
            for item in ordered:
                assert item.sprite is not None
                self._shine(image, item.mesh, _Shown(item.sprite, None))
        image[~self.backdrop.lit] = 0
        return image

    def _cast(self, image: ImageArray, item: _Shown, mesh: Mesh) -> None:
        assert item.agent is not None
        assert item.xy is not None
        self._shadow(image, mesh, item.xy, item.agent.size_m[:2], item.heading)

    def _shadow(
        self,
        image: ImageArray,
        mesh: Mesh,
        xy: FloatArray,
        size: tuple[float, float],
        heading: float = 0.0,
    ) -> None:
        light = self.backdrop.light
        if light.sun.any():
            soft = 1.0 if self.camera.size[0] < 1200 else 2.0
            cast = shadow(mesh.quads, self.camera, light.to_sun, soft)
            if cast is not None:
                self._darken(image, *cast, light.shade)
        # Under everything lies a soft dark patch, where little of the sky shines.
        turn = np.linspace(0, 2 * np.pi, 17)[:-1]
        c, s = np.cos(heading), np.sin(heading)
        ring = np.stack([size[0] * 0.55 * np.cos(turn), size[1] * 0.62 * np.sin(turn)], axis=1)
        flat = np.zeros((16, 3))
        flat[:, :2] = ring @ np.array([[c, s], [-s, c]]) + xy
        pixels = self.camera.pixels(flat)
        if not np.isfinite(pixels).all():
            return
        low = np.floor(pixels.min(axis=0)).astype(int) - 4
        high = np.ceil(pixels.max(axis=0)).astype(int) + 4
        if (high <= 0).any() or (low >= self.camera.size).any() or (high - low > 3000).any():
            return
        patch = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
        cv2.fillPoly(
            patch, [np.round((pixels - low - 0.5) * 16).astype(np.int32)], 255, cv2.LINE_AA, 4
        )
        blur = max(int(min(patch.shape) * 0.12), 1) * 2 + 1
        soft_patch = np.asarray(cv2.GaussianBlur(patch, (blur, blur), 0), np.float32) / 255
        self._darken(image, int(low[0]), int(low[1]), soft_patch, np.array([0.6, 0.6, 0.62]))

    def _darken(
        self, image: ImageArray, left: int, top: int, cover: Float32Array, keep: FloatArray
    ) -> None:
        """Multiplies the picture by `keep` [3] where `cover` is 1."""
        spot = inside(self.camera.size, left, top, cover.shape[1], cover.shape[0])
        if spot is None:
            return
        rows, columns, patch_rows, patch_columns = spot
        part = image[rows, columns]
        gain = 1 - cover[patch_rows, patch_columns, None] * (1 - keep.astype(np.float32))
        part[:] = cv2.multiply(part, gain, dtype=cv2.CV_8U)

    def _paste(self, image: ImageArray, sprite: Sprite, _: None) -> None:
        height, width = sprite.alpha.shape
        spot = inside(self.camera.size, sprite.left, sprite.top, width, height)
        if spot is None:
            return
        rows, columns, patch_rows, patch_columns = spot
        part = image[rows, columns]
        middle = self.backdrop.vignette[
            (rows.start + rows.stop) // 2, (columns.start + columns.stop) // 2
        ]
        clear = cv2.merge([255 - sprite.alpha[patch_rows, patch_columns]] * 3)
        kept = cv2.multiply(part, clear, scale=1 / 255)
        colour = sprite.colour[patch_rows, patch_columns]
        haze = 1 - float(np.exp(-max(sprite.away_m - 15, 0) / self.backdrop.light.haze_m))
        if haze > 0.01:
            low = self.backdrop.light.sky_low.astype(np.float32)
            alpha = sprite.alpha[patch_rows, patch_columns, None].astype(np.float32) / 255
            colour = (colour * (1 - haze) + alpha * low * haze).astype(np.uint8)
        part[:] = cv2.addWeighted(kept, 1.0, colour, float(middle), 0)

    def _shine(self, image: ImageArray, mesh: Mesh, item: _Shown) -> None:
        """Halos about lamps that look toward the camera."""
        eye = self.camera.eye_m
        for lamp in mesh.lamps:
            pixel = self.camera.pixels(lamp.at[None])[0]
            if not np.isfinite(pixel).all():
                continue
            if item.agent is not None:
                out = lamp.at[:2] - (item.xy if item.xy is not None else lamp.at[:2])
                toward = float(out @ (eye[:2] - lamp.at[:2]))
                if toward < 0:
                    continue
            away = float(np.linalg.norm(lamp.at - eye))
            dark = 1.0 if self.conditions.light == "night" else 0.5
            radius = min(0.75 * lamp.strength**0.5 * self.camera.focal_px / max(away, 1.5), 220.0)
            glow = halo(radius)
            r = glow.shape[0] // 2
            left, top = int(pixel[0]) - r, int(pixel[1]) - r
            spot = inside(self.camera.size, left, top, 2 * r + 1, 2 * r + 1)
            if spot is None:
                continue
            rows, columns, patch_rows, patch_columns = spot
            light = glow[patch_rows, patch_columns, None] * np.array(lamp.colour, np.float32)
            part = image[rows, columns]
            part[:] = cv2.add(part, (light * dark).astype(np.uint8))

    # -- labels -----------------------------------------------------------------------------

    def _labels(self, shown: list[tuple[_Shown, Mesh | None]]) -> list[DrawnObject]:
        for i, (near, _) in enumerate(shown):  # far ones first: each hides those before it
            for far, _ in shown[:i]:
                if far.left is not None and _touch(far.sprite, near.sprite):
                    _hide(far, near.sprite)
        objects: dict[int, DrawnObject] = {}
        for item, _ in shown:
            if item.left is None:
                continue
            drawn = self._object(item)
            if drawn is not None:
                objects[drawn.id] = drawn
        own = [objects[a.id] for a in self.scenario.agents if a.id in objects]
        return own + [objects[k] for k in sorted(objects, reverse=True) if k < 0]

    def _object(self, item: _Shown) -> DrawnObject | None:
        sprite = item.sprite
        assert item.left is not None
        assert item.xy is not None
        height, width = sprite.alpha.shape
        spot = inside(self.camera.size, sprite.left, sprite.top, width, height)
        if spot is None:
            return None
        rows, columns, patch_rows, patch_columns = spot
        left = item.left[patch_rows, patch_columns] * self.backdrop.lit[rows, columns]
        seen = left >= 0.4
        across, down = np.flatnonzero(seen.any(axis=0)), np.flatnonzero(seen.any(axis=1))
        if len(across) == 0:
            return None
        raw = np.array(
            [
                columns.start + across[0],
                rows.start + down[0],
                columns.start + across[-1] + 1,
                rows.start + down[-1] + 1,
            ],
            np.float64,
        )
        # Where the silhouette's own edge shows, it is known better than to a pixel.
        full = np.array(sprite.full_box_px)
        limit = np.array([0.0, 0.0, *self.camera.size])
        box = np.where(np.abs(raw - full) <= 1.5, full, raw)
        box = np.concatenate([np.maximum(box[:2], limit[:2]), np.minimum(box[2:], limit[2:])])
        if (box[2:] - box[:2] < _MIN_PX).any():
            return None
        ground = self.camera.pose.world_to_ground(item.xy)
        kind = item.agent.kind if item.agent is not None else "car"
        return DrawnObject(
            id=item.fixed_id,
            kind=kind,
            label=KINDS[kind],
            box_px=(float(box[0]), float(box[1]), float(box[2]), float(box[3])),
            full_box_px=sprite.full_box_px,
            visible=float(min(left.sum() / max(sprite.area_px, 1e-6), 1.0)),
            xy_m=(float(ground[0]), float(ground[1])),
            world_m=(float(item.xy[0]), float(item.xy[1])),
            heading_rad=float(item.heading),
        )


def _share(sprite: Sprite) -> Float32Array:
    return np.asarray(sprite.alpha, np.float32) / 255


def _touch(one: Sprite, other: Sprite) -> bool:
    (h, w), (k, v) = one.alpha.shape, other.alpha.shape
    return (
        one.left < other.left + v
        and other.left < one.left + w
        and one.top < other.top + k
        and other.top < one.top + h
    )


def _hide(far: _Shown, near: Sprite) -> None:
    """Takes from `far` what `near` covers."""
    assert far.left is not None
    height, width = far.left.shape
    x0 = max(near.left - far.sprite.left, 0)
    y0 = max(near.top - far.sprite.top, 0)
    x1 = min(near.left + near.alpha.shape[1] - far.sprite.left, width)
    y1 = min(near.top + near.alpha.shape[0] - far.sprite.top, height)
    dx, dy = far.sprite.left - near.left, far.sprite.top - near.top
    cover = near.alpha[y0 + dy : y1 + dy, x0 + dx : x1 + dx]
    far.left[y0:y1, x0:x1] *= 1 - cover.astype(np.float32) / 255


def _travelled(agent: Agent, t: float) -> tuple[float, bool]:
    """Metres covered since the start, and whether the agent moves just now."""
    times = agent.path[:, 0]
    steps = np.hypot(*np.diff(agent.path[:, 1:], axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    segment = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(steps) - 1))
    speed = steps[segment] / (times[segment + 1] - times[segment])
    return float(np.interp(t, times, way)), bool(speed > 0.1)


def _dense(path: FloatArray) -> FloatArray:
    """The path [n, 2] with a point at least every 0.5 m."""
    pieces = [path[:1]]
    for a, b in zip(path, path[1:], strict=False):
        count = max(int(np.hypot(*(b - a)) / 0.5), 1)
        pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)


def _in_the_way(what: str, xy: tuple[float, float], paths: FloatArray) -> bool:
    """Whether somebody would walk or ride through this fixture."""
    apart = np.abs(paths - np.array(xy))
    if what == "car":
        return bool(
            ((apart[:, 0] < 2.4 + _PATH_CLEAR_M) & (apart[:, 1] < 0.95 + _PATH_CLEAR_M)).any()
        )
    return bool((np.hypot(apart[:, 0], apart[:, 1]) < _PATH_CLEAR_M).any())
