"""World to pixel to ground: the paper's equations 1 to 5 once more, in plain scalars."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from bikeped.errors import GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.geometry.lens import Lens

repeatable = settings(derandomize=True, deadline=None, max_examples=80)
WIDEST = {
    "equidistant": 220.0,
    "equisolid": 220.0,
    "stereographic": 200.0,
    "orthographic": 174.0,
    "perspective": 110.0,
}
INVERSE = {
    "equidistant": lambda r: r,
    "equisolid": lambda r: 2 * math.asin(r / 2),
    "stereographic": lambda r: 2 * math.atan(r / 2),
    "orthographic": math.asin,
    "perspective": math.atan,
}
CURVE = {
    "equidistant": lambda t: t,
    "equisolid": lambda t: 2 * math.sin(t / 2),
    "stereographic": lambda t: 2 * math.tan(t / 2),
    "orthographic": math.sin,
    "perspective": math.tan,
}
TERMS = [(0.0, 0.0, 0.0, 0.0), (0.03, -0.004, 0.0005, 0.00001)]

cameras = st.builds(
    lambda model, k, height, pitch, heading, radius, cx: GroundCamera(
        Lens.from_circle(model, radius, WIDEST[model], k), cx, 1804.54, height, pitch, heading
    ),
    st.sampled_from(sorted(WIDEST)),
    st.sampled_from(TERMS),
    st.floats(1.0, 12.0),
    st.floats(-90, 20),
    st.floats(-180, 180),
    st.floats(300, 1800),
    st.floats(1700, 1800),
)


def deployed(**changes):
    values = {"cx": 1752.69, "cy": 1804.54, "height_m": 3.6576}
    lens = Lens.from_circle("equidistant", 1750.0, 197.90)
    return GroundCamera(lens, **{**values, **changes})


def plain_theta(camera, radius):
    """The angle of an image radius, by bisection where there are radial terms."""
    model, k = camera.lens.projection, camera.lens.k
    if not any(k):
        return INVERSE[model](radius / camera.lens.focal_px)
    low, high = 0.0, camera.lens.max_theta_rad
    for _ in range(200):
        middle = (low + high) / 2
        gain = 1 + sum(term * middle ** (2 * i + 2) for i, term in enumerate(k))
        if camera.lens.focal_px * CURVE[model](middle) * gain < radius:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def plain_ground(camera, u, v):
    """Equations 1 to 5 as the paper prints them; None above the horizon."""
    du, dv = u - camera.cx, v - camera.cy
    theta, phi = plain_theta(camera, math.sqrt(du * du + dv * dv)), math.atan2(dv, du)
    d = (math.cos(theta), math.sin(theta) * math.cos(phi), -math.sin(theta) * math.sin(phi))
    a = math.radians(camera.pitch_deg)
    dx = math.cos(a) * d[0] - math.sin(a) * d[2]
    dy = d[1]
    dz = math.sin(a) * d[0] + math.cos(a) * d[2]
    if dz >= 0:
        return None
    t = -camera.height_m / dz
    x, y = t * dx, t * dy
    h = math.radians(camera.heading_deg)  # y points right, so a turn to the right is x towards y
    return x * math.cos(h) - y * math.sin(h), x * math.sin(h) + y * math.cos(h)


def plain_project(camera, x, y, z):
    """A point's pixel by the inverse way: heading, pitch, angle from the axis, radius."""
    h, a = math.radians(camera.heading_deg), math.radians(camera.pitch_deg)
    x, y, z = x * math.cos(h) + y * math.sin(h), -x * math.sin(h) + y * math.cos(h), z
    z -= camera.height_m
    cx = math.cos(a) * x + math.sin(a) * z
    cz = -math.sin(a) * x + math.cos(a) * z
    side = math.sqrt(y * y + cz * cz)
    theta = math.atan2(side, cx)
    gain = 1 + sum(term * theta ** (2 * i + 2) for i, term in enumerate(camera.lens.k))
    radius = camera.lens.focal_px * CURVE[camera.lens.projection](theta) * gain
    return camera.cx + radius * y / side, camera.cy - radius * cz / side, theta


@repeatable
@given(cameras, st.floats(0.0, 0.999), st.floats(-math.pi, math.pi))
def test_ground_of_a_pixel_is_equations_2_to_5(camera, part, azimuth):
    radius = part * camera.lens.max_radius_px
    u, v = camera.cx + radius * math.cos(azimuth), camera.cy + radius * math.sin(azimuth)
    expected = plain_ground(camera, u, v)
    if expected is not None:
        assume(0 < math.hypot(*expected) < 100)
    xy, valid = camera.ground([[u, v]])
    assert bool(valid[0]) is (expected is not None)
    if expected is not None:
        np.testing.assert_allclose(xy[0], expected, atol=1e-6, rtol=0)
    else:
        assert np.isnan(xy[0]).all()


@repeatable
@given(cameras, st.floats(0.05, 40), st.floats(-math.pi, math.pi))
def test_ground_to_pixel_to_ground(camera, distance, bearing):
    xy = np.array([[distance * math.cos(bearing), distance * math.sin(bearing)]])
    uv, _ = camera.project(xy)
    u, v, theta = plain_project(camera, xy[0, 0], xy[0, 1], 0.0)
    assume(theta < 0.999 * camera.lens.max_theta_rad)
    np.testing.assert_allclose(uv[0], (u, v), atol=1e-6, rtol=0)
    back, valid = camera.ground(uv)
    assert valid[0]
    np.testing.assert_allclose(back, xy, atol=1e-6, rtol=0)
    np.testing.assert_allclose(camera.project(back)[0], uv, atol=1e-6, rtol=0)


@repeatable
@given(cameras, st.floats(-30, 30), st.floats(-30, 30), st.floats(0, 4))
def test_points_in_the_air_project_as_written_out(camera, x, y, z):
    u, v, theta = plain_project(camera, x, y, z)
    assume(abs(theta - camera.lens.max_theta_rad) > 1e-9)
    uv, seen = camera.project([[x, y, z]])
    in_front = math.hypot(x, y, z - camera.height_m) * math.cos(theta) > 0.01
    assert bool(seen[0]) is (theta < camera.lens.max_theta_rad and in_front)
    if theta < camera.lens.max_theta_rad:
        np.testing.assert_allclose(uv[0], (u, v), atol=1e-6, rtol=0)


def test_axes_of_the_deployed_camera():
    camera = deployed()
    uv, seen = camera.project([[10.0, 0.0], [10.0, 2.0], [10.0, -2.0], [5.0, 0.0]])
    assert seen.all()
    assert uv[0, 0] == pytest.approx(1752.69, abs=1e-9)
    assert uv[0, 1] == pytest.approx(1804.54 + 1013.316 * math.atan(3.6576 / 10), abs=0.001)
    assert uv[1, 0] > uv[0, 0] > uv[2, 0]  # y to the right
    assert uv[3, 1] > uv[0, 1]  # nearer is lower
    _, valid = camera.ground([[1752.69, 1804.54 - 50], [1752.69, 1804.54], [1752.69, 1804.54 + 50]])
    assert valid.tolist() == [False, False, True]


def test_a_camera_that_looks_down_sees_its_foot():
    camera = deployed(pitch_deg=-90.0)
    xy, valid = camera.ground([[camera.cx, camera.cy], [camera.cx, camera.cy - 100]])
    assert valid.all()
    np.testing.assert_allclose(xy[0], 0.0, atol=1e-9)
    assert xy[1, 0] > 0.1  # up in the picture is forward


def test_heading_turns_the_axis_to_the_right_of_x():
    camera = deployed(heading_deg=90.0)
    uv, seen = camera.project([[0.0, 10.0]])  # straight to the right of x
    assert seen[0]
    assert uv[0, 0] == pytest.approx(camera.cx, abs=1e-6)


def test_seen_needs_the_sensor_the_field_of_view_and_the_front():
    framing = Framing(3840, 2160, 3840, 3500)
    camera = deployed(window_px=framing.window_px)
    _, seen = camera.project([[10.0, 0.0, 0.0]])
    assert seen[0]
    # Straight below the lens: inside the field of view (90 < 98.95) but not in front.
    assert not camera.project([[0.0, 0.0, 0.0]])[1][0]
    assert not camera.project([[0.02, 0.0, 0.0]])[1][0]  # in front, but below the sensor's rows
    assert deployed().project([[0.02, 0.0, 0.0]])[1][0]
    assert not camera.project([[0.0099, 3.0, 3.0]])[1][0]  # too little in front
    for v, there in ((670.0, True), (669.99, False), (2829.99, True), (2830.0, False)):
        angle = (v - camera.cy) / camera.lens.focal_px
        point = [[math.cos(angle), 0.0, camera.height_m - math.sin(angle)]]
        uv, seen = camera.project(point)
        assert uv[0, 1] == pytest.approx(v, abs=1e-6)
        if abs(v - round(v)) > 1e-9:  # on the very edge rounding decides
            assert bool(seen[0]) is there


def test_outside_the_image_circle_there_is_no_ground():
    camera = deployed()
    xy, valid = camera.ground([[camera.cx + 1000, camera.cy + 1500]])
    assert not valid[0]
    assert np.isnan(xy).all()


def test_height_must_be_above_the_ground():
    for height in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(GeometryError, match="height_m"):
            deployed(height_m=height)


@pytest.mark.parametrize(
    ("window_px", "visible"),
    [
        ((100, 80, 101, 81), True),
        ((0, 0, 100, 81), False),
        ((0, 0, 101, 80), False),
        ((101, 0, 200, 160), False),
        ((0, 81, 200, 160), False),
    ],
)
def test_the_window_holds_its_first_and_not_its_end_pixel(window_px, visible):
    lens = Lens.from_circle("equidistant", 100, 180)
    camera = GroundCamera(lens, cx=100, cy=80, height_m=2, window_px=window_px)
    uv, seen = camera.project([[5.0, 0.0, 2.0]])  # on the optical axis
    assert uv.tolist() == [[100, 80]]
    assert seen.tolist() == [visible]
