"""Pictures: the same each time, different where they should be, black outside the circle."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from bikeped.config.load import load_config
from bikeped.errors import GeometryError, ScenarioError
from bikeped.geometry.lens import Lens
from bikeped.lab.rendering import Conditions, SceneCamera, ScenePainter, scene_camera
from bikeped.lab.rendering.backdrop import backdrop
from bikeped.lab.rendering.compositing import paste_sprite
from bikeped.lab.rendering.conditions import LIGHTS, random_conditions
from bikeped.lab.rendering.dataset import SceneMix, random_camera, random_scenario
from bikeped.lab.rendering.render_camera import lens_camera, rays, rectilinear_camera
from bikeped.lab.rendering.sprite import Sprite
from bikeped.lab.rendering.street_layout import street_layout
from bikeped.lab.scenarios.scenario import SIZES_M, Agent, Scenario, bundled_folder, load_scenario
from bikeped.types import ImageArray

SIZE = (320, 180)


@pytest.fixture(scope="module")
def view() -> SceneCamera:
    return scene_camera(load_config(None, ()), SIZE)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(bundled_folder() / "multiple-vrus.yaml")


def test_same_arguments_give_the_same_bytes(view: SceneCamera, scenario: Scenario) -> None:
    conditions = Conditions(seed=4, weather="rain", place=3)
    first = ScenePainter(scenario, view, conditions)
    wanted = [first.draw(t) for t in (5.0, 5.1)]
    backdrop.cache_clear()
    rays.cache_clear()
    again = ScenePainter(scenario, view, conditions)
    # In another order: a picture must not depend on the one before.
    for t, (image, objects) in reversed(list(zip((5.0, 5.1), wanted, strict=True))):
        assert again.objects(t) == objects
        assert (again.frame(t) == image).all()
    assert (wanted[0][0] != wanted[1][0]).any()


def test_furniture_is_where_it_is_drawn(view: SceneCamera, scenario: Scenario) -> None:
    painter = ScenePainter(scenario, view)
    things = painter.furniture()
    assert {"tree", "lamp", "signal"} <= {what for what, _ in things}
    assert "car" not in {what for what, _ in things}  # a road user
    bare = backdrop(view, painter.conditions).image.astype(int)
    full = painter.frame(0.0).astype(int)
    for what, (u1, v1, u2, v2) in things:
        assert max(u1, 0) < min(u2, view.size[0])
        assert max(v1, 0) < min(v2, view.size[1])
        rows = slice(max(int(v1), 0), int(v2) + 1)
        columns = slice(max(int(u1), 0), int(u2) + 1)
        assert np.abs(full - bare)[rows, columns].max() > 8, what


def test_shadows_lie_where_it_is_darker(view: SceneCamera, scenario: Scenario) -> None:
    painter = ScenePainter(scenario, view, Conditions(noise=0.0))
    shadows = painter.shadows(5.0)
    assert len(shadows) >= len(painter.objects(5.0)) / 2
    street = backdrop(view, painter.conditions).image.astype(int)
    image = painter.frame(5.0).astype(int)
    for u1, v1, u2, v2 in shadows:
        spot = (slice(max(int(v1), 0), int(v2)), slice(max(int(u1), 0), int(u2)))
        assert (street - image)[spot].max() > 25
    assert ScenePainter(scenario, view, Conditions(light="night")).shadows(5.0) == []


@pytest.mark.parametrize("middle_u", [19, 160])
def test_a_figure_is_as_dark_as_the_lens_is_at_each_of_its_pixels(
    view: SceneCamera, middle_u: int
) -> None:
    """Also across the rim, where the lens is dark at the figure's middle and bright at its side."""
    street = backdrop(view, Conditions())
    spot = (slice(120, 150), slice(middle_u - 15, middle_u + 15))
    whole = np.full((30, 30), 255, np.uint8)
    figure = Sprite(spot[1].start, 120, cv2.merge([whole - 55] * 3), whole, (0, 0, 1, 1), 1.0)
    image = np.zeros((*SIZE[::-1], 3), np.uint8)
    paste_sprite(image, street, figure)
    assert np.abs(image[spot] - 200.0 * street.vignette[spot][..., None]).max() < 10
    assert image[spot].max() > 100
    assert (image[spot].min() < 5) == (middle_u == 19)
    assert image.sum() == image[spot].sum()


def test_who_stands_in_the_black_of_the_rim_shows_in_part(view: SceneCamera) -> None:
    """Where the lens lets next to no light through, somebody counts only as far as he is lit."""
    light = rays(view).vignette * rays(view).lit
    v, u = np.nonzero((light > 0) & (light < 0.15))
    xy, valid = view.camera.ground(view.framing.frame_to_crop(np.stack([u, v], 1) + 0.5))
    near = valid & (np.hypot(*xy.T) < 8)
    spots = view.pose.ground_to_world(xy[near])[:: max(1, near.sum() // 12)]
    shares = []
    for x, y in spots.tolist():
        stands = np.array([[0.0, x, y], [20.0, x + 0.05, y]])
        nobody_else = Scenario(
            "rim", "safe", "idle", "bicycle", (Agent(1, "pedestrian", stands, (0.25, 0.4, 1.1)),)
        )
        for item in ScenePainter(nobody_else, view, Conditions()).objects(5.0):
            if item.id == 1:
                u1, v1, u2, v2 = (round(side) for side in item.box_px)
                assert light[v1:v2, u1:u2].max() >= 0.15, item
                shares.append(item.visible)
    assert len(shares) > 10
    assert np.mean(shares) < 0.9  # all of them have their feet in the dark


def test_a_picture_is_the_callers_own(view: SceneCamera, scenario: Scenario) -> None:
    painter = ScenePainter(scenario, view)
    image, objects = painter.draw(4.0)
    kept = image.copy()
    image[:] = 0
    objects.clear()
    assert (painter.frame(4.0) == kept).all()
    assert painter.objects(4.0)


@pytest.mark.parametrize("light", LIGHTS)
def test_who_is_there_shows_in_every_light(
    view: SceneCamera, scenario: Scenario, light: str
) -> None:
    conditions = Conditions(light=light, noise=0.0)
    with_all = ScenePainter(scenario, view, conditions)
    nobody = Scenario("empty", "safe", "idle", "bicycle", (_far_away(),))
    street = ScenePainter(nobody, view, conditions).frame(5.0).astype(int)
    image, objects = with_all.draw(5.0)
    inside_any = np.zeros(SIZE[::-1], bool)
    for item in objects:
        if item.id < 0 or item.visible < 0.5:
            continue
        u1, v1, u2, v2 = (round(v) for v in item.box_px)
        inside_any[v1:v2, u1:u2] = True
        change = np.abs(image[v1:v2, u1:u2].astype(int) - street[v1:v2, u1:u2]).max(axis=2)
        assert (change > 6).mean() > 0.2, item
    # Light from lamps and shadows reaches beyond the boxes, but not everywhere.
    changed = (np.abs(image.astype(int) - street).max(axis=2) > 6) & ~inside_any
    assert changed.mean() < 0.12


def _far_away() -> Agent:
    return Agent(
        1, "pedestrian", np.array([[0.0, 5, -90], [20.0, 5.1, -90]]), SIZES_M["pedestrian"]
    )


def _mean(image: ImageArray) -> float:
    return float(image.mean())


def test_lights_differ_as_they_should(view: SceneCamera, scenario: Scenario) -> None:
    shots = {
        light: _mean(ScenePainter(scenario, view, Conditions(light=light)).frame(3.0))
        for light in LIGHTS
    }
    assert shots["night"] < shots["dusk"] < shots["day"]
    assert shots["glare"] > shots["overcast"] > shots["night"]


def test_it_is_black_outside_the_circle(view: SceneCamera, scenario: Scenario) -> None:
    image = ScenePainter(scenario, view, Conditions(light="glare", noise=5)).frame(1.0)
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    crop = view.framing.frame_to_crop(np.stack([u, v], axis=-1))
    reach = np.hypot(crop[..., 0] - view.camera.cx, crop[..., 1] - view.camera.cy)
    outside = reach > view.camera.lens.max_radius_px + view.framing.scale
    assert outside.any()
    assert image[outside].max() == 0
    assert np.median(image[~outside].max(axis=1)) > 40


def test_rays_are_the_cameras(view: SceneCamera) -> None:
    found = rays(view)
    for u, v in ((160, 90), (60, 120), (250, 170), (161, 30)):
        crop = view.framing.frame_to_crop(np.array([[u + 0.5, v + 0.5]]))
        ground = view.camera.rays(crop)[0]
        level = view.pose.ground_to_world(ground[:2]) - (view.pose.x_m, view.pose.y_m)
        # 4 picture pixels are 48 of the sensor's here: the coarsest that is in use.
        assert found.world[v, u] == pytest.approx([*level, ground[2]], abs=6e-4)


def test_straight_lines_stay_straight_only_in_an_ordinary_lens() -> None:
    line = np.stack([np.linspace(-3, 13, 9), np.full(9, -9.0), np.zeros(9)], axis=1)

    def bend(camera: SceneCamera) -> float:
        pixels = camera.pixels(line)
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        way = pixels[-1] - pixels[0]
        away = pixels - pixels[0]
        return float(np.abs(away[:, 0] * way[1] - away[:, 1] * way[0]).max() / np.hypot(*way))

    assert bend(rectilinear_camera(90, (640, 360))) < 1e-6
    fisheye = lens_camera(Lens.from_circle("equidistant", 320, 190), (640, 360), pitch_deg=-15)
    assert bend(fisheye) > 5


def test_an_ordinary_camera_fills_its_picture(scenario: Scenario) -> None:
    view = rectilinear_camera(90, SIZE)
    corner = view.camera.rays(np.array([[0.0, 90.0], [320.0, 90.0]]))
    angle = math.degrees(math.acos(float(corner[0] @ corner[1])))
    assert angle == pytest.approx(90, abs=0.01)
    image, objects = ScenePainter(scenario, view).draw(5.0)
    assert (image.max(axis=2) > 0).mean() > 0.99
    assert any(item.id > 0 for item in objects)


@pytest.mark.parametrize(
    "wrong",
    [{"light": "dawn"}, {"weather": "snow"}, {"noise": -1.0}, {"noise": 99.0}, {"seed": -1}],
)
def test_conditions_say_what_is_wrong(wrong: dict[str, object]) -> None:
    with pytest.raises(ScenarioError, match=next(iter(wrong))):
        Conditions(**wrong)  # type: ignore[arg-type]


def test_cameras_say_what_is_wrong() -> None:
    with pytest.raises(GeometryError, match="size"):
        rectilinear_camera(90, (4, 4))
    with pytest.raises(GeometryError, match="fov_deg"):
        rectilinear_camera(179)
    with pytest.raises(GeometryError, match="lens"):
        random_camera(1, lens="pinhole")
    with pytest.raises(GeometryError, match=r"camera\.width"):
        scene_camera(load_config(None, ()), (640, 640))


def test_random_draws_repeat_and_differ() -> None:
    assert random_conditions(3) == random_conditions(3)
    assert len({random_conditions(i).place for i in range(20)}) == 20
    assert {random_conditions(i).light for i in range(60)} == set(LIGHTS)
    one, same = random_scenario(8), random_scenario(8)
    for a, b in zip(one.agents, same.agents, strict=True):
        assert a.kind == b.kind
        assert (a.path == b.path).all()
    assert random_camera(5) == random_camera(5)
    assert random_camera(5) != random_camera(6)
    kinds = {agent.kind for i in range(80) for agent in random_scenario(i).agents}
    assert kinds == set(SIZES_M)


def test_as_many_e_scooters_and_wheelchairs_as_asked_for() -> None:
    def share(kind: str, length_m: float, mix: SceneMix) -> float:
        agents = [a for i in range(150) for a in random_scenario(i, mix).agents]
        found = [a.size_m[0] == length_m for a in agents if a.kind == kind]
        return sum(found) / len(found)

    assert share("cyclist", 1.2, SceneMix(scooters=0.0)) == 0.0
    assert share("cyclist", 1.2, SceneMix(scooters=1.0)) == 1.0
    assert 0.35 < share("cyclist", 1.2, SceneMix(scooters=0.45)) < 0.55
    assert share("pedestrian", 1.1, SceneMix(wheelchairs=0.0)) == 0.0
    assert 0.25 < share("pedestrian", 1.1, SceneMix(wheelchairs=0.3)) < 0.35


def test_clutter_adds_things_near_the_camera_and_leaves_the_rest() -> None:
    plain, full = street_layout(7), street_layout(7, 5)
    assert full.fixtures[: len(plain.fixtures)] == plain.fixtures
    more = full.fixtures[len(plain.fixtures) :]
    assert len(more) == 5
    assert {item.what for item in more} <= {"bollard", "bin", "sign", "hydrant"}
    assert all(-4 <= item.xy_m[0] <= 14 and item.xy_m[1] < -plain.kerb for item in more)
    assert {random_conditions(i, 3).clutter for i in range(40)} == {0, 1, 2, 3}
    assert random_conditions(5, 3) == replace(
        random_conditions(5), clutter=random_conditions(5, 3).clutter
    )


def test_random_people_stand_near_and_far_and_still() -> None:
    away, still = [], 0
    for i in range(120):
        for agent in random_scenario(i).agents:
            state = agent.at(3.0)
            assert state is not None
            away.append(math.dist(state[0], (5, -13)))
            still += bool(math.dist(agent.path[0, 1:], agent.path[-1, 1:]) < 0.1)
    assert min(away) < 2.2
    assert 30 < max(away) < 41
    assert 0.1 < still / len(away) < 0.5
