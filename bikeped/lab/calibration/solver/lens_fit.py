"""One lens model fitted to a set of boards, with what a person needs to trust it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.geometry import Lens
from bikeped.geometry.lens import unit_radius
from bikeped.lab.calibration.solver.board_shape import gauge_basis, prior_weights
from bikeped.lab.calibration.solver.bundle_adjustment import Adjusted, Stage, adjust
from bikeped.lab.calibration.solver.cross_validation import held_out_residuals
from bikeped.lab.calibration.solver.jacobian import jacobian
from bikeped.lab.calibration.solver.lens_model import (
    PLAIN,
    Model,
    Sightings,
    State,
    angles,
    camera_points,
    gain,
)
from bikeped.lab.calibration.solver.normal_equations import normal_equations
from bikeped.lab.calibration.solver.single_thread import one_thread
from bikeped.types import FloatArray


@dataclass(frozen=True)
class Fit:
    """A model's best state and its errors. Arrays are [V, C, ...] as in the sightings."""

    model: Model
    state: State
    stages: tuple[Stage, ...]
    sightings: Sightings
    residuals_px: FloatArray
    held_out_px: (
        FloatArray | None
    )  #: residuals of each picture when it did not help; None: not asked
    covariance: FloatArray  #: of the lens's parameters, in the model's order

    @property
    def name(self) -> str:
        return self.model.name

    @property
    def rms_px(self) -> float:
        """Per point: sqrt(mean(dx^2 + dy^2))."""
        return rms_per_point(self.residuals_px, self.sightings)

    @property
    def rms_per_coordinate_px(self) -> float:
        """sqrt(mean over all coordinates), smaller by sqrt(2)."""
        return self.rms_px / float(np.sqrt(2))

    @property
    def cross_validated_px(self) -> float | None:
        """Per point, over pictures that did not help to fit the lens."""
        return None if self.held_out_px is None else rms_per_point(self.held_out_px, self.sightings)

    @property
    def cx(self) -> float:
        return float(self.state.lens[0])

    @property
    def cy(self) -> float:
        return float(self.state.lens[1])

    @property
    def focal_px(self) -> float:
        return float(self.state.lens[2])

    @property
    def uncertainty(self) -> dict[str, float]:
        """One standard deviation of each parameter of the lens. It knows the corners' noise only,
        not a wrong model: see the cross-validated error."""
        sigma = np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))
        return {n: float(s) for n, s in zip(self.model.parameters, sigma, strict=True)}

    def radius_sigma_px(self, theta: FloatArray) -> FloatArray:
        """One standard deviation of r(theta), from the covariance of f and the radial terms."""
        base = unit_radius(self.state.projection, theta)
        slopes = [base * gain(theta, self.state.lens[PLAIN:])]
        slopes += [self.focal_px * base * theta ** (2 * n + 2) for n in range(self.model.terms)]
        rows = np.stack(slopes, axis=-1)
        inner = self.covariance[2:, 2:]
        return np.asarray(np.sqrt(np.maximum(((rows @ inner) * rows).sum(-1), 0.0)))

    @property
    def angles_rad(self) -> FloatArray:
        """[V, C] each corner's angle from the optical axis."""
        return angles(camera_points(self.state, self.sightings.flat))

    @property
    def measured_to_rad(self) -> float:
        """The largest angle at which a corner was seen."""
        return float(self.angles_rad[self.sightings.seen].max())

    def radius(self, theta: FloatArray) -> FloatArray:
        """r(theta) in pixels, also where no `Lens` is valid."""
        return np.asarray(
            self.focal_px
            * unit_radius(self.state.projection, theta)
            * gain(theta, self.state.lens[PLAIN:])
        )

    def lens(self, max_theta_rad: float) -> Lens:
        """The project's lens, valid to an angle; GeometryError where it cannot be."""
        return Lens(self.state.projection, self.focal_px, max_theta_rad, self.state.terms)


@one_thread
def fit(sightings: Sightings, model: Model, start: State, folds: int | None = None) -> Fit:
    """Adjusts the model from `start`, its uncertainty, and cross-validates it over `folds`
    (0: each picture by itself; None: not at all)."""
    adjusted = adjust(sightings, model, start)
    held_out = held_out_residuals(adjusted, sightings, folds) if folds is not None else None
    return Fit(
        model,
        adjusted.state,
        adjusted.stages,
        sightings,
        adjusted.residuals_px,
        held_out,
        covariance_of(adjusted, sightings),
    )


def covariance_of(adjusted: Adjusted, sightings: Sightings) -> FloatArray:
    """Covariance of the lens's parameters: the normal matrix without poses and shape, inverted,
    times the variance that the residuals show."""
    state, flat = adjusted.state, sightings.flat
    basis = gauge_basis(flat) if adjusted.model.board else None
    normal = normal_equations(
        jacobian(state, flat, bent=adjusted.model.board),
        adjusted.residuals_px,
        sightings.seen.astype(np.float64),
        basis,
    )
    free = 2 * sightings.seen.sum() - 6 * len(sightings) - len(state.lens)
    square = float((adjusted.residuals_px**2).sum())
    if basis is not None:
        m = len(state.lens)
        spread = prior_weights(len(flat)) * adjusted.sigma_px**2
        normal.shared[m:, m:] += basis.T @ (spread[:, None] * basis)
        free -= basis.shape[1]
    variance = square / max(int(free), 1)
    return np.asarray(normal.reduced_inverse(len(state.lens)) * variance)


def rms_per_point(error: FloatArray, sightings: Sightings) -> float:
    """sqrt(mean(dx^2 + dy^2)) over the corners that were seen, pixels."""
    return float(np.sqrt((error[sightings.seen] ** 2).sum(-1).mean()))


def rms_by_picture(error: FloatArray, sightings: Sightings) -> FloatArray:
    """[V] the same for each picture."""
    count = sightings.seen.sum(1)
    return np.asarray(np.sqrt((error**2).sum((1, 2)) / np.maximum(count, 1)))
