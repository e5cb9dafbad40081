"""Lens models: radius against angle, both ways."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.errors import GeometryError
from bikeped.geometry.lens import Lens, canonical_projection

repeatable = settings(derandomize=True, deadline=None, max_examples=60)

#: g(theta) for f = 1, and the widest field of view in degrees that these tests use.
CURVES = {
    "equidistant": (lambda t: t, 220.0),
    "equisolid": (lambda t: 2 * math.sin(t / 2), 220.0),
    "stereographic": (lambda t: 2 * math.tan(t / 2), 220.0),
    "orthographic": (lambda t: math.sin(t), 176.0),
    "perspective": (lambda t: math.tan(t), 120.0),
}
models = st.sampled_from(sorted(CURVES))
mild = st.floats(-0.02, 0.05)
radial = st.one_of(
    st.just((0.0, 0.0, 0.0, 0.0)),
    st.tuples(mild, st.floats(-0.002, 0.01), st.floats(0, 0.001), st.floats(0, 0.0002)),
)


@repeatable
@given(models, st.floats(80, 3000), st.floats(0.2, 1.0), radial, st.floats(0, 1))
def test_radius_follows_the_formula_and_theta_inverts_it(model, focal, share, k, part):
    curve, widest = CURVES[model]
    half = math.radians(widest / 2 * share)
    lens = Lens(model, focal, half, k)
    theta = half * part
    gain = 1 + sum(term * theta ** (2 * i + 2) for i, term in enumerate(k))
    radius = float(lens.radius(theta))
    assert radius == pytest.approx(focal * curve(theta) * gain, abs=1e-6)
    back = float(lens.theta(radius))
    assert back == pytest.approx(theta, abs=1e-9)
    assert float(lens.radius(back)) == pytest.approx(radius, abs=1e-6)


@pytest.mark.parametrize("k", [(0.0, 0.0, 0.0, 0.0), (0.03, -0.004, 0.0005, 0.0)])
@pytest.mark.parametrize("model", sorted(CURVES))
def test_pixels_go_there_and_back_to_the_rim(model, k):
    lens = Lens.from_circle(model, 1750.0, CURVES[model][1], k)
    radius = np.linspace(0, lens.max_radius_px, 5001)
    np.testing.assert_allclose(lens.radius(lens.theta(radius)), radius, atol=1e-6, rtol=0)


@pytest.mark.parametrize("projection", sorted(CURVES))
def test_the_inverse_with_terms_is_exact_to_the_last_digits(projection):
    lens = Lens.from_circle(projection, 1750.0, 170.0, (-0.02, 0.012, -0.004, 0.0007))
    radius = np.linspace(1, 0.999 * lens.max_radius_px, 20001)
    np.testing.assert_allclose(lens.radius(lens.theta(radius)), radius, rtol=2e-13)


def test_orthographic_with_terms_inverts_to_its_very_rim():
    # There the radius hardly grows with the angle: the hardest place for Newton's method.
    lens = Lens("orthographic", 1000.0, math.pi / 2, (0.002, 0.0, 0.0, 0.0))
    radius = np.linspace(0, lens.max_radius_px, 20001)
    np.testing.assert_allclose(lens.radius(lens.theta(radius)), radius, atol=1e-6, rtol=0)


def test_the_equidistant_terms_are_those_of_the_definitions():
    lens = Lens("equidistant", 1000.0, 1.7, (0.01, -0.002, 0.0, 0.0))
    for theta in (0.0, 0.3, 1.0, 1.6):
        expected = 1000.0 * (theta + 0.01 * theta**3 - 0.002 * theta**5)
        assert float(lens.radius(theta)) == pytest.approx(expected, abs=1e-9)


def test_outside_the_circle_there_is_no_angle():
    for k in ((0.0, 0.0, 0.0, 0.0), (0.01, 0.0, 0.0, 0.0)):
        lens = Lens("equidistant", 1000.0, 1.5, k)
        edge = lens.max_radius_px
        assert np.isfinite(lens.theta(edge))
        assert np.isnan(lens.theta(edge + 0.001))
        assert np.isnan(lens.theta(float("nan")))


def test_installers_radius_gives_the_papers_focal_length():
    lens = Lens.from_circle("equidistant", 1750.0, 197.90)
    assert lens.focal_px == pytest.approx(2 * 1750 * 180 / (197.90 * math.pi), rel=1e-12)
    assert lens.focal_px == pytest.approx(1013.31, abs=0.01)


@pytest.mark.parametrize("model", sorted(CURVES))
def test_the_field_of_view_ends_at_the_radius(model):
    lens = Lens.from_circle(model, 700.0, CURVES[model][1])
    assert lens.max_radius_px == pytest.approx(700.0, abs=1e-9)
    assert float(lens.radius(math.radians(CURVES[model][1]) / 2)) == pytest.approx(700.0, abs=1e-9)


def test_names():
    assert canonical_projection("linear") == "equidistant"
    assert canonical_projection("equalarea") == "equisolid"
    for name in CURVES:
        assert canonical_projection(name) == name
    with pytest.raises(GeometryError, match=r"fishy.*equidistant"):
        canonical_projection("fishy")


@pytest.mark.parametrize(
    ("model", "half_deg", "k"),
    [
        ("equidistant", 99, (-0.2, 0.0, 0.0, 0.0)),
        ("equidistant", 99, (0.0, 0.0, 0.0, -0.01)),
        ("equisolid", 99, (-0.1, 0.0, 0.0, 0.0)),
        ("stereographic", 99, (-0.5, 0.0, 0.0, 0.0)),
        ("orthographic", 89, (-0.05, 0.0, 0.0, 0.0)),
    ],
)
def test_radial_terms_that_fold_the_image_are_refused_with_the_angle(model, half_deg, k):
    with pytest.raises(GeometryError, match=r"stops growing at (\d+\.\d) degrees") as refused:
        Lens(model, 1000.0, math.radians(half_deg), k)
    angle = math.radians(float(str(refused.value).split(" at ")[1].split()[0]))
    assert angle <= math.radians(half_deg)
    Lens(model, 1000.0, angle * 0.99, k)  # up to there it is a lens


def test_angles_that_a_model_cannot_show_are_refused():
    for model, fov in (("orthographic", 197.9), ("perspective", 180), ("stereographic", 359)):
        with pytest.raises(GeometryError, match="fov_deg"):
            Lens.from_circle(model, 1750.0, fov)
    for bad in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(GeometryError, match="focal length"):
            Lens("equidistant", bad, 1.0)
    with pytest.raises(GeometryError, match="fov_deg"):
        Lens.from_circle("equidistant", 1750.0, 0.0)
