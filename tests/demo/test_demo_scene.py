import functools

import numpy as np
import pytest

from bikeped.conformance.scenario import SIZES_M, load_scenario, parse_scenario
from bikeped.demo import DEMO_POSE, Scene, bundled_scenario
from bikeped.errors import GeometryError
from bikeped.geometry import CameraPose, Framing, GroundCamera, Lens

FRAMING = Framing(3840, 2160, 3840, 3500)
CAMERA = GroundCamera(
    Lens.from_circle("equidistant", 1750, 197.9),
    1752.69,
    1804.54,
    3.6576,
    window_px=FRAMING.window_px,
)
SIZE = (1280, 720)
SENSOR = np.array([170, -670])  #: crop to sensor pixels


def standing(kind, x, y, turn=(1.0, 0.0)):
    """A scenario of one agent that passes (x, y) at 1 s in direction `turn`."""
    a = f"[0.0, {x - turn[0]}, {y - turn[1]}], [2.0, {x + turn[0]}, {y + turn[1]}]"
    return parse_scenario(f"name: One\nagents:\n  - {{id: 1, kind: {kind}, path: [{a}]}}\n", "test")


@functools.cache
def empty_street():
    return Scene(standing("pedestrian", 5, 0), CAMERA, FRAMING, DEMO_POSE, SIZE)


def scene_of(scenario):
    scene = empty_street()
    clone = object.__new__(Scene)
    clone.__dict__.update(scene.__dict__)
    clone.scenario = scenario
    return clone


@pytest.mark.parametrize("kind", sorted(SIZES_M))
@pytest.mark.parametrize(("x", "y"), [(5.0, -6.0), (-4.0, -5.0), (14.0, -8.0), (9.0, 8.0)])
@pytest.mark.parametrize("turn", [(1.0, 0.0), (-0.6, 0.8)])
def test_box_encloses_what_was_drawn_and_is_not_much_larger(kind, x, y, turn):
    scene = scene_of(standing(kind, x, y, turn))
    (drawn,) = scene.objects(1.0)
    different = (scene.frame(1.0) != scene.frame(1.0, without={1})).any(-1)
    v, u = np.nonzero(different)
    u1, v1, u2, v2 = drawn.box_px
    # Straight edges of long near bodies bulge out of their corners' rectangle in a fisheye.
    slack = 1.5 + (0.12 if kind in {"bus", "truck"} else 0.02) * max(u2 - u1, v2 - v1)
    assert u.min() >= u1 - slack
    assert v.min() >= v1 - slack
    assert u.max() <= u2 + slack
    assert v.max() <= v2 + slack
    assert np.ptp(u) > 0.6 * (u2 - u1) - 2
    assert np.ptp(v) > 0.6 * (v2 - v1) - 2


def test_box_is_that_of_the_definitions():
    scene = scene_of(standing("cyclist", 2.0, -4.0))
    (drawn,) = scene.objects(1.0)
    corners = [
        (2.0 + 0.9 * a, -4.0 + 0.3 * b, z) for a in (-1, 1) for b in (-1, 1) for z in (0.0, 1.7)
    ]
    ground = [(y + 13.0, x - 5.0, z) for x, y, z in corners]  # the camera looks north
    crop, seen = CAMERA.project(ground)
    assert seen.all()
    pixels = (crop + SENSOR) / 3  # crop to sensor, sensor to 1280
    expected = [*pixels.min(axis=0), *pixels.max(axis=0)]
    assert np.allclose(drawn.box_px, expected, atol=1e-6)
    assert np.allclose(drawn.xy_m, (9.0, -3.0))
    assert drawn.world_m == (2.0, -4.0)


def test_bottom_centre_of_the_box_leads_back_to_the_ground_nearby():
    scene = scene_of(standing("pedestrian", 3.0, -5.0))
    (drawn,) = scene.objects(1.0)
    u1, _, u2, v2 = drawn.box_px
    crop = FRAMING.for_frame(*SIZE).frame_to_crop([[(u1 + u2) / 2, v2]])
    xy, valid = CAMERA.ground(crop)
    assert valid.all()
    assert np.hypot(*(xy[0] - drawn.xy_m)) < 0.5


def test_box_is_clipped_to_the_frame_and_gone_behind_the_camera():
    (near,) = scene_of(standing("pedestrian", 5.0, -11.4)).objects(1.0)
    assert near.box_px[3] == 720
    assert scene_of(standing("pedestrian", 5.0, -16.0)).objects(1.0) == []
    assert scene_of(standing("pedestrian", 5.0, 0.0)).objects(2.5) == [], "past its last waypoint"


def test_the_crossing_is_drawn_where_the_world_has_it():
    image = empty_street().frame(1.0, without={1}).astype(int)
    bars = [(5.0, -8.15 + k) for k in range(4)]
    gaps = [(5.0, -7.65 + k) for k in range(4)]

    def brightness(points):
        crop, _ = CAMERA.project([(y + 13, x - 5) for x, y in points])
        uv = ((crop + SENSOR) / 3).round().astype(int)
        return image[uv[:, 1], uv[:, 0]].sum(axis=1) / 3

    assert brightness(bars).min() > brightness(gaps).max() + 50
    rim = image[5, 5]
    assert not rim.any(), "outside the image circle it is black"


def test_nearer_bodies_hide_farther_ones():
    text = (
        "name: Two\nagents:\n"
        "  - {id: 1, kind: pedestrian, path: [[0, 5, -7], [2, 5.02, -7]]}\n"
        "  - {id: 2, kind: bus, path: [[0, 3, -2], [2, 7, -2]]}\n"
    )
    scene = scene_of(parse_scenario(text, "test"))
    assert (scene.frame(1.0) != scene.frame(1.0, without={1})).any()
    (walker, _) = scene.objects(1.0)
    u, v = round((walker.box_px[0] + walker.box_px[2]) / 2), round(np.mean(walker.box_px[1::2]))
    alone = scene.frame(1.0, without={2})
    assert (scene.frame(1.0)[v, u] == alone[v, u]).all()


def test_frames_repeat_and_move():
    scene = scene_of(load_scenario(bundled_scenario()))
    assert (scene.frame(7.0) == scene.frame(7.0)).all()
    assert (scene.frame(7.0) != scene.frame(7.1)).any()


def test_other_poses_and_proportions():
    scenario = standing("car", 5.0, 0.0)
    looking_south = Scene(scenario, CAMERA, FRAMING, CameraPose(5, 13, -90), (640, 360))
    (drawn,) = looking_south.objects(1.0)
    assert np.allclose(drawn.xy_m, (13.0, 0.0))
    with pytest.raises(GeometryError, match="proportions"):
        Scene(scenario, CAMERA, FRAMING, DEMO_POSE, (640, 480))
