"""The ground table against the closed form that it stands for."""

import tracemalloc

import numpy as np
import pytest

from bikeped.errors import GeometryError
from bikeped.geometry.camera import GroundCamera, GroundTable
from bikeped.geometry.lens import Lens

CASES = [
    # model, fov, k, radius, side, height, pitch, heading, step
    ("equidistant", 197.9, (0, 0, 0, 0), 1750, 3500, 3.6576, 0, 0, 8),
    ("equidistant", 220, (0.01, -0.002, 0.0003, 0), 1750, 3500, 5.5, -40, 25, 8),
    ("equisolid", 197.9, (0, 0, 0, 0), 1750, 3500, 2.5, -40, -60, 8),
    ("equisolid", 200, (0.02, 0, 0, 0), 600, 1200, 7.5, -90, 180, 8),
    ("stereographic", 200, (0, 0, 0, 0), 1750, 3500, 3.6576, -10, 0, 8),
    ("orthographic", 180, (0, 0, 0, 0), 1750, 3500, 3.6576, 0, 0, 8),
    ("orthographic", 179, (0, 0, 0, 0), 900, 1800, 6.0, -60, 45, 16),
    ("perspective", 100, (0, 0, 0, 0), 960, 1920, 4.0, -30, 10, 8),
    ("equidistant", 197.9, (0, 0, 0, 0), 150, 300, 3.6576, -20, 0, 8),  # a tiny image
    ("equidistant", 197.9, (0, 0, 0, 0), 1750, 3500, 1.0, 0, 0, 16),  # a low camera
    ("equidistant", 197.9, (0, 0, 0, 0), 500, 1000, 30.0, -45, 0, 32),  # a high one, coarse
]


def camera_of(case):
    model, fov, k, radius, side, height, pitch, heading, _ = case
    lens = Lens.from_circle(model, radius, fov, k)
    return GroundCamera(lens, side / 2 + 2.69, side / 2 - 4.54, height, pitch, heading)


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c[0]}-{c[3]}px-{c[5]}m-{c[6]}")
def test_within_1_cm_of_the_closed_form_out_to_25_m(case):
    camera, side, step = camera_of(case), case[4], case[8]
    table = GroundTable(camera, side, side, step)
    rng = np.random.default_rng(7)
    anywhere = rng.uniform(0, side, (60_000, 2))
    # Ground points to 25 m, densest where the angle says most, and the circle's rim.
    distance, bearing = rng.uniform(0, 25, 60_000), rng.uniform(-np.pi, np.pi, 60_000)
    on_ground, _ = camera.project(
        np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=1)
    )
    radius = camera.lens.max_radius_px - rng.uniform(0, 12, 40_000) ** 2 / 12
    around = rng.uniform(-np.pi, np.pi, 40_000)
    rim = np.stack(
        [camera.cx + radius * np.cos(around), camera.cy + radius * np.sin(around)], axis=1
    )
    uv = np.concatenate([anywhere, on_ground, rim])
    uv = uv[(uv >= 0).all(axis=1) & (uv <= side).all(axis=1)]
    truth, valid = camera.ground(uv)
    xy, table_valid = table.lookup(uv)
    near = valid & (np.hypot(truth[:, 0], truth[:, 1]) <= 25)
    assert near.sum() > 1000
    assert table_valid[near].all()
    error = np.hypot(*(xy[near] - truth[near]).T)
    assert error.max() < 0.01
    # Nothing beyond the horizon or the circle comes near by interpolation.
    wrong = table_valid & ~valid
    assert not wrong.any() or np.hypot(*xy[wrong].T).min() > 25
    assert np.isnan(xy[~table_valid]).all()


def test_lattice_points_carry_the_closed_form_rays():
    camera = camera_of(CASES[0])
    table = GroundTable(camera, 3500, 3500)
    v, u = np.mgrid[1900:2800:80, 400:3000:80]
    uv = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    truth, valid = camera.ground(uv)
    xy, table_valid = table.lookup(uv)
    assert (valid == table_valid).all()
    near = valid & (np.hypot(*np.nan_to_num(truth, nan=np.inf).T) < 25)
    np.testing.assert_allclose(xy[near], truth[near], atol=2e-4)  # float32 rays


def test_memory_of_the_deployed_table():
    camera = camera_of(CASES[0])
    tracemalloc.start()
    try:
        table = GroundTable(camera, 3500, 3500)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 1e6 < table.nbytes <= 100e6
    assert peak <= 130e6
    assert table._exact.mean() < 0.5  # most of it is answered from the lattice


def test_the_finest_lattice_stays_within_memory_too():
    camera = camera_of(CASES[0])
    table = GroundTable(camera, 3500, 3500, step_px=2)
    assert table.nbytes <= 100e6


def test_outside_the_crop_is_invalid_but_its_far_edges_are_inside():
    # An ordinary camera without padding: a box cut by the frame's lower edge ends at v = height.
    lens = Lens.from_circle("perspective", 1200.0, 90.0)
    camera = GroundCamera(lens, 959.5, 539.5, 4.0, -30.0)
    table = GroundTable(camera, 1920, 1080)
    uv = np.array([[960.0, 1080.0], [1920.0, 700.0], [0.0, 700.0], [1920.0, 1080.0]])
    xy, valid = table.lookup(uv)
    assert valid.all()
    np.testing.assert_allclose(xy, camera.ground(uv)[0], atol=0.01)
    outside = [[960, 1080.01], [1920.01, 700], [-0.01, 700], [960, -0.01], [np.nan, 700]]
    xy, valid = table.lookup(outside)
    assert not valid.any()
    assert np.isnan(xy).all()


def test_nothing_and_one_pixel():
    table = GroundTable(camera_of(CASES[0]), 3500, 3500, 64)
    xy, valid = table.lookup(np.zeros((0, 2)))
    assert xy.shape == (0, 2)
    assert valid.shape == (0,)
    xy, valid = table.lookup([1752.0, 2200.0])
    assert xy.shape == (1, 2)
    assert valid[0]


@pytest.mark.parametrize("size", [(1, 100, 8), (100, 1, 8), (100, 100, 0)])
def test_sizes_that_are_no_image_are_refused(size):
    with pytest.raises(GeometryError, match="not an image"):
        GroundTable(camera_of(CASES[0]), *size)
