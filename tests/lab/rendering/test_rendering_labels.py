"""Boxes and shares agree with the camera model and with who stands before whom."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.config.load import load_config
from bikeped.geometry.camera import GroundCamera
from bikeped.lab.rendering import Conditions, DrawnObject, SceneCamera, ScenePainter, scene_camera
from bikeped.lab.rendering.conditions import lighting
from bikeped.lab.rendering.people import Appearance, person
from bikeped.lab.rendering.sprite import rasterise
from bikeped.lab.scenarios.scenario import SIZES_M, Agent, Scenario
from bikeped.types import FloatArray, Kind

SIZE = (640, 360)
PLAIN = Conditions(light="overcast", noise=0.0)
CHILD = (0.25, 0.35, 1.1)
WHEELCHAIR = (1.1, 0.65, 1.3)
SCOOTER = (1.2, 0.5, 1.75)


@pytest.fixture(scope="module")
def view() -> SceneCamera:
    return scene_camera(load_config(None, ()), SIZE)


def standing(
    number: int,
    kind: str,
    distance_m: float,
    bearing_deg: float = 0.0,
    heading_deg: float = 0.0,
    size: tuple[float, float, float] | None = None,
) -> Agent:
    """Somebody who is `distance_m` before the usual camera at one second, hardly moving."""
    b, h = math.radians(bearing_deg), math.radians(heading_deg)
    x, y = 5 + distance_m * math.sin(b), -13 + distance_m * math.cos(b)
    dx, dy = 0.01 * math.cos(h), 0.01 * math.sin(h)
    path = np.array([[0.0, x - dx, y - dy], [2.0, x + dx, y + dy]])
    return Agent(number, kind, path, size or SIZES_M[kind])


def seen(view: SceneCamera, *agents: Agent) -> dict[int, DrawnObject]:
    scenario = Scenario("test", "safe", "idle", "bicycle", agents)
    return {item.id: item for item in ScenePainter(scenario, view, PLAIN).objects(1.0)}


def corner_box(view: SceneCamera, agent: Agent) -> FloatArray:
    """The rectangle of the 8 corners of the agent's box (definitions, section 3), unclipped."""
    state = agent.at(1.0)
    assert state is not None
    length, width, height = agent.size_m
    c, s = math.cos(state[1]), math.sin(state[1])
    flat = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (length / 2, width / 2)
    turned = flat @ np.array([[c, s], [-s, c]]) + state[0]
    corners = np.concatenate([np.column_stack([turned, np.full(4, z)]) for z in (0.0, height)])
    pixels = view.pixels(corners)
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


WHO = st.sampled_from(
    [
        ("pedestrian", None, 0.30),
        ("pedestrian", CHILD, 0.30),
        ("pedestrian", WHEELCHAIR, 0.65),
        ("cyclist", None, 0.75),
        ("cyclist", SCOOTER, 0.65),
        ("car", None, 3.0),
    ]
)


@settings(max_examples=40, deadline=None)
@given(
    who=WHO,
    distance_m=st.floats(7.0, 20.0),
    bearing_deg=st.floats(-55, 55),
    heading_deg=st.floats(-180, 180),
)
def test_boxes_stand_where_the_ground_model_says(
    view: SceneCamera,
    who: tuple[str, tuple[float, float, float] | None, float],
    distance_m: float,
    bearing_deg: float,
    heading_deg: float,
) -> None:
    kind, size, reach_m = who
    agent = standing(1, kind, distance_m, bearing_deg, heading_deg, size)
    item = seen(view, agent)[1]
    expected = corner_box(view, agent)
    full = np.array(item.full_box_px)
    # A body fills its box and does not leave it; shoes reach a little further than 0.3 m.
    nearest_m = distance_m - math.hypot(agent.size_m[0], agent.size_m[1]) / 2
    slack = 2.0 + 0.12 * view.focal_px / nearest_m
    assert (full[:2] >= expected[:2] - slack).all()
    assert (full[2:] <= expected[2:] + slack).all()
    assert full[3] - full[1] > 0.65 * (expected[3] - expected[1])
    if item.visible > 0.99:
        middle = np.array([[(item.box_px[0] + item.box_px[2]) / 2, item.box_px[3]]])
        ground, valid = view.camera.ground(view.framing.frame_to_crop(middle))
        assert valid[0]
        pixel_m = distance_m**2 / (view.camera.height_m * view.focal_px)
        assert math.dist(ground[0], item.xy_m) < reach_m + pixel_m


def test_labels_give_the_scenarios_truth(view: SceneCamera) -> None:
    agent = standing(7, "cyclist", 9.0, 20.0, 70.0)
    item = seen(view, agent)[7]
    state = agent.at(1.0)
    assert state is not None
    assert item.label is Kind.CYCLIST
    assert item.world_m == pytest.approx(tuple(state[0]))
    assert item.xy_m == pytest.approx((9 * math.cos(0.349066), 9 * math.sin(0.349066)), abs=1e-4)
    assert item.heading_rad == pytest.approx(math.radians(70))
    assert item.distance_m == pytest.approx(9.0)
    assert item.visible > 0.99


def test_a_box_is_the_silhouettes(view: SceneCamera) -> None:
    mesh = person((0.3, 0.5, 1.7), Appearance.random(np.random.default_rng(1)), 0.4, True)
    sprite = rasterise(mesh.placed((6.0, -6.0), 1.0), view, lighting(PLAIN), distance_m=7.0)
    assert sprite is not None
    covered = sprite.alpha >= 100
    rows, columns = np.flatnonzero(covered.any(axis=1)), np.flatnonzero(covered.any(axis=0))
    mask = np.array(
        [
            sprite.left + columns[0],
            sprite.top + rows[0],
            sprite.left + columns[-1] + 1,
            sprite.top + rows[-1] + 1,
        ]
    )
    assert np.abs(mask - np.array(sprite.full_box_px)).max() <= 1.5


def test_feet_are_on_the_ground_at_every_step() -> None:
    looks = Appearance.random(np.random.default_rng(5))
    for way in np.linspace(0, 1.42, 15):
        low = person((0.3, 0.5, 1.7), looks, float(way), True).quads[..., 2].min()
        assert low == pytest.approx(0.0, abs=0.006)


def test_who_stands_behind_another_is_hidden(view: SceneCamera) -> None:
    far, near = standing(1, "pedestrian", 12.0), standing(2, "pedestrian", 8.0, 0.5)
    alone = seen(view, far)[1]
    both = seen(view, far, near)
    assert alone.visible > 0.99
    assert both[2].visible > 0.99
    assert both[1].visible < 0.75
    # Of the far one the head shows above the near one's, never more than it has.
    assert both[1].box_px[3] <= alone.box_px[3] + 1e-6
    assert both[1].full_box_px == alone.full_box_px


def test_a_truck_hides_a_child_wholly(view: SceneCamera) -> None:
    objects = seen(view, standing(1, "pedestrian", 15.0, size=CHILD), standing(2, "truck", 8.0))
    assert 1 not in objects or objects[1].visible < 0.02
    assert objects[2].label is Kind.VEHICLE


def test_what_the_picture_cuts_off_is_not_visible(view: SceneCamera) -> None:
    item = seen(view, standing(1, "pedestrian", 2.0))[1]
    assert item.box_px[3] <= SIZE[1]
    assert item.full_box_px[3] > SIZE[1]
    assert 0.2 < item.visible < 0.98


def test_nobody_behind_the_camera_or_before_and_after_their_time(view: SceneCamera) -> None:
    agents = (standing(1, "pedestrian", -6.0), standing(2, "pedestrian", 9.0))
    scenario = Scenario("test", "safe", "idle", "bicycle", agents)
    painter = ScenePainter(scenario, view, PLAIN)
    assert [item.id for item in painter.objects(1.0) if item.id > 0] == [2]
    assert [item.id for item in painter.objects(2.3) if item.id > 0] == []


def test_parked_cars_are_labelled_and_never_in_somebodys_way(view: SceneCamera) -> None:
    parked = [item for item in seen(view, standing(1, "pedestrian", 9.0)).values() if item.id < 0]
    assert len(parked) >= 2
    assert {item.label for item in parked} == {Kind.VEHICLE}
    x, y = parked[0].world_m
    path = np.array([[0.0, x, y - 5], [2.0, x, y + 5]])
    through = Agent(1, "cyclist", path, SIZES_M["cyclist"])
    left = [item.world_m for item in seen(view, through).values() if item.id < 0]
    assert (x, y) not in left


def test_the_picture_and_the_deployed_table_agree_on_a_foot(view: SceneCamera) -> None:
    # Not the painter's own projection: the configured camera's, on the full sensor.
    camera: GroundCamera = view.camera
    uv, _ = camera.project(np.array([[9.0, 1.0]]))
    frame = view.framing.crop_to_frame(uv)[0]
    world = view.pose.ground_to_world(np.array([[9.0, 1.0]]))[0]
    assert view.pixels(np.array([[*world, 0.0]]))[0] == pytest.approx(frame)
