"""One lens model fitted to a set of boards, with its errors and uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.geometry import Lens
from bikeped.geometry.lens import unit_radius
from bikeped.lab.calibration.solver.bundle_adjustment import AdjustmentResult, ShapePrior, adjust
from bikeped.lab.calibration.solver.cross_validation import held_out_residuals
from bikeped.lab.calibration.solver.jacobian import jacobian
from bikeped.lab.calibration.solver.lens_model import (
    PLAIN,
    CalibrationState,
    CornerObservations,
    LensModel,
    corner_angles,
    radial_factor,
)
from bikeped.lab.calibration.solver.normal_equations import normal_equations, single_threaded
from bikeped.types import FloatArray


@dataclass(frozen=True)
class LensFit(AdjustmentResult):
    """An adjustment with its cross-validation and uncertainty; arrays [V, C, ...]."""

    observations: CornerObservations
    #: Residuals of each image when it was held out; None: not cross-validated.
    held_out_px: FloatArray | None
    covariance: FloatArray  #: of the lens's parameters, in the model's order

    @property
    def name(self) -> str:
        return self.model.name

    @property
    def rms_px(self) -> float:
        """Per point: sqrt(mean(dx^2 + dy^2))."""
        return rms_per_point(self.residuals_px, self.observations)

    @property
    def rms_per_coordinate_px(self) -> float:
        """sqrt(mean over all coordinates), smaller by sqrt(2)."""
        return self.rms_px / float(np.sqrt(2))

    @property
    def cross_validated_px(self) -> float | None:
        """Per point, over images that were held out."""
        if self.held_out_px is None:
            return None
        return rms_per_point(self.held_out_px, self.observations)

    @property
    def ranking_px(self) -> float:
        """The error by which models are ranked: cross-validated where known, else RMS per point."""
        return self.cross_validated_px or self.rms_px

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
        """One standard deviation of each lens parameter, from the corners' noise only.

        It does not cover a wrong model: see the cross-validated error.
        """
        sigma = np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))
        return {n: float(s) for n, s in zip(self.model.parameters, sigma, strict=True)}

    def radius_sigma_px(self, theta: FloatArray) -> FloatArray:
        """One standard deviation of r(theta), from the covariance of f and the radial terms."""
        base = unit_radius(self.state.projection, theta)
        slopes = [base * radial_factor(theta, self.state.lens[PLAIN:])]
        slopes += [self.focal_px * base * theta ** (2 * n + 2) for n in range(self.model.terms)]
        rows = np.stack(slopes, axis=-1)
        inner = self.covariance[2:, 2:]
        return np.asarray(np.sqrt(np.maximum(((rows @ inner) * rows).sum(-1), 0.0)))

    @property
    def angles_rad(self) -> FloatArray:
        """[V, C] each corner's angle from the optical axis."""
        return corner_angles(self.state, self.observations)

    @property
    def measured_to_rad(self) -> float:
        """The largest angle of an observed corner."""
        return float(self.angles_rad[self.observations.visible].max())

    def lens(self, max_theta_rad: float) -> Lens:
        """The project's lens, valid to an angle; GeometryError where it cannot be."""
        return Lens(self.state.projection, self.focal_px, max_theta_rad, self.state.terms)


@single_threaded
def fit_lens(
    observations: CornerObservations,
    model: LensModel,
    start: CalibrationState,
    folds: int | None = None,
) -> LensFit:
    """Adjusts the model from `start`, with its covariance, and cross-validates it over `folds`.

    `folds` 0: each image is a fold; None: no cross-validation.
    """
    adjusted = adjust(observations, model, start)
    held_out = held_out_residuals(adjusted, observations, folds) if folds is not None else None
    covariance = _covariance(adjusted, observations)
    return LensFit(
        **vars(adjusted), observations=observations, held_out_px=held_out, covariance=covariance
    )


def _covariance(adjusted: AdjustmentResult, observations: CornerObservations) -> FloatArray:
    """Covariance of the lens's parameters: the normal matrix with poses and shape eliminated,
    inverted, times the variance of the residuals."""
    state, bent = adjusted.state, adjusted.model.board
    prior = ShapePrior.of(observations, state) if bent else None
    normal = normal_equations(
        jacobian(state, observations.flat, bent=bent),
        adjusted.residuals_px,
        observations.visible.astype(np.float64),
        None if prior is None else prior.basis,
    )
    free = 2 * observations.visible.sum() - 6 * len(observations) - len(state.lens)
    if prior is not None:
        normal = prior.added(normal, state)
        free -= prior.basis.shape[1]
    variance = float((adjusted.residuals_px**2).sum()) / max(int(free), 1)
    return np.asarray(normal.reduced_inverse(len(state.lens)) * variance)


def rms_per_point(error: FloatArray, observations: CornerObservations) -> float:
    """sqrt(mean(dx^2 + dy^2)) over the visible corners, pixels."""
    return float(np.sqrt((error[observations.visible] ** 2).sum(-1).mean()))


def rms_by_image(error: FloatArray, observations: CornerObservations) -> FloatArray:
    """[V] the same for each image."""
    count = observations.visible.sum(1)
    return np.asarray(np.sqrt((error**2).sum((1, 2)) / np.maximum(count, 1)))
