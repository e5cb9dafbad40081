"""Fits a camera's height and direction to ground marks with measured distances.

Least squares over the deployed geometry (`GroundCamera.ground`): each measurement is compared with
the camera's reading at the mark's pixel. Near the horizon a pixel covers tens of centimetres of
ground, so residuals are weighted by tape and pixel accuracy: their covariance is
tape^2 I + px^2 G G^T, where G is the derivative of the readings by the marks' pixels (first-order
orthogonal distance regression; Boggs and Rogers 1990). Levenberg-Marquardt starts from the current
values and from a grid of pitches, so a wrong start does not matter. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from bikeped.errors import GeometryError
from bikeped.geometry.alignment import (
    PARAMETER_NAMES,
    Alignment,
    AlignmentFit,
    Mark,
    MeasurementAccuracy,
    Residual,
    Spacing,
    pixel_at_distance,
)
from bikeped.geometry.camera import GroundCamera
from bikeped.types import FloatArray

#: A parameter is undetermined where its standard error exceeds this many of its scales.
_LIMIT = {"height_m": 3, "pitch_deg": 2, "radius_px": 3, "cx": 4, "cy": 4, "heading_deg": 5}
_MAX_ITERATIONS = 60


def fit_alignment(
    camera: GroundCamera,
    marks: Sequence[Mark],
    spacings: Sequence[Spacing] = (),
    free: Sequence[str] = ("height_m", "pitch_deg"),
    accuracy: MeasurementAccuracy | None = None,
) -> AlignmentFit:
    """The alignment that fits the measurements best; parameters not in `free` stay `camera`'s.

    Raises GeometryError, naming what to measure, when the marks do not determine the parameters.
    """
    unknown = [name for name in free if name not in PARAMETER_NAMES]
    if unknown or not free or len(set(free)) < len(free):
        raise GeometryError(
            f"free: {', '.join(unknown) or 'nothing, or a name twice'}; use some of "
            f"{', '.join(PARAMETER_NAMES)}"
        )
    problem = _Problem(camera, marks, spacings, free, accuracy or MeasurementAccuracy())
    problem.check()
    solutions = [problem.minimise(start) for start in problem.starts()]
    found = sorted(((*problem.costs(x), x) for x in solutions), key=itemgetter(0))
    if not found:
        raise GeometryError(
            "no pitch puts every mark on the ground: is each on flat ground, below the horizon, "
            "and set where it lies in the picture?"
        )
    _, cost, best = found[0]
    covariance = problem.covariance(best, cost)
    error = dict(zip(free, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    problem.check_unique(found, error)
    answer = AlignmentFit(
        alignment=best,
        standard_errors=error,
        residuals=problem.residuals(best),
        redundancy=problem.count - len(free),
        standard_error_at_10m_m=problem.standard_error_at_10m(best, covariance),
    )
    return replace(answer, suspect_mark=_suspect_mark(problem, cost)) if answer.outliers else answer


def _suspect_mark(problem: _Problem, cost: float) -> str | None:
    """The mark without which the others agree; least squares spreads its error over all marks."""
    marks, candidates = problem.marks, []
    for i, mark in enumerate(marks):
        kept = [
            Spacing(s.first - (s.first > i), s.second - (s.second > i), s.distance_m)
            for s in problem.spacings
            if i not in (s.first, s.second)
        ]
        fewer = replace(problem, marks=[*marks[:i], *marks[i + 1 :]], spacings=kept)
        if fewer.count > len(problem.free):
            squares = (fewer.costs(fewer.minimise(start))[1] for start in fewer.starts())
            candidates.append((min(squares, default=math.inf), mark.name))
    best = min(candidates, default=(math.inf, ""))
    return best[1] if best[0] < 0.2 * cost else None


@dataclass
class _Problem:
    """The weighted least-squares problem of the marks and spacings."""

    like: GroundCamera
    marks: Sequence[Mark]
    spacings: Sequence[Spacing]
    free: Sequence[str]
    accuracy: MeasurementAccuracy

    def __post_init__(self) -> None:
        marks = self.marks
        self.uv_px = np.array([[m.u_px, m.v_px] for m in marks], np.float64).reshape(-1, 2)
        rows: list[tuple[str, str, int, int, float]] = []  # mark, quantity, indices, metres
        for i, mark in enumerate(marks):
            for quantity in ("distance", "forward", "right"):
                value = getattr(mark, f"{quantity}_m")
                if value is not None:
                    rows.append((mark.name, quantity, i, i, float(value)))
        for spacing in self.spacings:
            i, j = spacing.first, spacing.second
            if not (0 <= i < len(marks) and 0 <= j < len(marks)) or i == j:
                raise GeometryError("spacings: name two different marks that are there")
            if not (math.isfinite(spacing.distance_m) and spacing.distance_m > 0):
                raise GeometryError(
                    f"spacing {marks[i].name}-{marks[j].name}: {spacing.distance_m:g} must be "
                    "above 0"
                )
            rows.append((f"{marks[i].name}-{marks[j].name}", "spacing", i, j, spacing.distance_m))
        self.rows, self.count = rows, len(rows)
        self.measured_m = np.array([row[4] for row in rows])

    def check(self) -> None:
        """Raises GeometryError for marks that no fit can use."""
        if self.count < len(self.free):
            names = _names(self.free)
            missing = len(self.free) - self.count
            raise GeometryError(
                f"{self.count} measurement{'s' * (self.count != 1)} cannot determine "
                f"{len(self.free)} parameters ({names}): add {missing} more, better two or three"
            )
        for i, mark in enumerate(self.marks):
            for other in self.marks[:i]:
                if math.hypot(mark.u_px - other.u_px, mark.v_px - other.v_px) < 1:
                    raise GeometryError(
                        f"marks {other.name} and {mark.name} are the same pixel; move or delete one"
                    )
        if not {"radius_px", "cx", "cy"} & set(self.free):
            dark = np.isnan(self.like.rays(self.uv_px)).any(axis=1)
            if dark.any():
                raise GeometryError(
                    f"mark {self.marks[int(np.argmax(dark))].name} lies outside the image circle; "
                    "move it, or correct radius and centre first"
                )

    def predict(self, alignment: Alignment) -> tuple[FloatArray, FloatArray]:
        """The camera's reading of each measurement [m], and its derivative by mark pixels [m, 2n].

        All NaN when a mark is not on the ground, or the parameters give no camera.
        """
        step = 0.25
        around = step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        value, slope = np.empty(self.count), np.zeros((self.count, 2 * len(self.marks)))
        try:
            xy, valid = alignment.camera(self.like).ground(self.uv_px[:, None, :] + around)
        except GeometryError:
            valid = np.zeros(1, np.bool_)
        if not valid.all():
            return np.full_like(value, np.nan), np.full_like(slope, np.nan)
        for row, (_, quantity, i, j, _) in enumerate(self.rows):
            for k, other in ((i, j), (j, i)) if quantity == "spacing" else ((i, i),):
                reads = _measure(quantity, xy[k], xy[other, 0])
                value[row] = reads[0]
                slope[row, 2 * k] = (reads[1] - reads[2]) / (2 * step)
                slope[row, 2 * k + 1] = (reads[3] - reads[4]) / (2 * step)
        return value, slope

    def residual_covariance(self, slope: FloatArray) -> FloatArray:
        """Covariance [m, m] of the residuals, from tape and pixel."""
        tape, mark = self.accuracy.tape_m, self.accuracy.mark_px
        return np.asarray(tape**2 * np.eye(self.count) + mark**2 * slope @ slope.T)

    def starts(self) -> list[Alignment]:
        """The camera's own values and a grid of pitches (and headings): the best four, best first.

        Positions are proportional to the height, which gives each pitch its height directly.
        """
        own = Alignment.of(self.like)
        pitches = range(-85, 45, 5) if "pitch_deg" in self.free else [own.pitch_deg]
        headings = range(-180, 180, 45) if "heading_deg" in self.free else [0]
        grid = [
            replace(own, pitch_deg=float(pitch), heading_deg=own.heading_deg + offset)
            for pitch in pitches
            for offset in headings
        ]
        found = []
        for start in (own, *grid):
            if "height_m" in self.free:
                value, _ = self.predict(start)
                size = float(value @ value)
                share = float(value @ self.measured_m) / size if size > 0 else 1.0
                if 0.1 < start.height_m * share <= 100:
                    start = replace(start, height_m=start.height_m * share)
            found.append((self.costs(start)[0], start))
        found.sort(key=itemgetter(0))
        return [start for score, start in found[:4] if math.isfinite(score)]

    def costs(self, alignment: Alignment) -> tuple[float, float]:
        """Minus twice the log likelihood (up to a constant), and the weighted sum of squares.

        Solutions are compared by the likelihood: near the horizon nothing is precise, and every
        sum of squares is small. Infinite where there is no reading.
        """
        value, slope = self.predict(alignment)
        if np.isnan(value).any():
            return math.inf, math.inf
        residual, covariance = value - self.measured_m, self.residual_covariance(slope)
        squares = float(residual @ np.linalg.solve(covariance, residual))
        return squares + float(np.linalg.slogdet(covariance)[1]), squares

    def minimise(self, start: Alignment) -> Alignment:
        """Levenberg-Marquardt from `start`, reweighted at every step.

        Weights are constant within a step: as part of the cost they would lower it by moving
        marks toward the horizon, where nothing is precise.
        """
        here, damping = start, 1e-3
        for _ in range(_MAX_ITERATIONS):
            weight, value, jacobian = self.linearised(here)
            if np.isnan(jacobian).any():
                break
            residual = weight @ (value - self.measured_m)
            normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
            while damping < 1e9:
                damped = normal + damping * np.diag(np.diag(normal) + 1e-12)
                step = -np.linalg.solve(damped, gradient)
                there = self.stepped(here, np.clip(step, -10, 10))
                new_residual = weight @ (self.predict(there)[0] - self.measured_m)
                if new_residual @ new_residual <= residual @ residual:  # not where it is NaN
                    break
                damping *= 4
            else:
                break
            damping = max(damping / 10, 1e-12)
            here = there
            if float(np.abs(step).max()) < 1e-9:
                break
        return here

    def stepped(self, alignment: Alignment, steps: FloatArray) -> Alignment:
        """`alignment` with each free parameter changed by `steps` [p] of its scales."""
        to = {
            name: getattr(alignment, name) + float(by) * alignment.scale(name)
            for name, by in zip(self.free, steps, strict=True)
        }
        return replace(alignment, **to)

    def linearised(self, at: Alignment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The weights [m, m] of the residuals, the readings [m], and the weighted derivative [m, p]
        of the readings by the scaled free parameters (NaN at the edge of the possible range)."""
        value, slope = self.predict(at)
        weight = np.linalg.inv(np.linalg.cholesky(self.residual_covariance(slope)))
        return weight, value, weight @ self._derivatives(at, lambda a: self.predict(a)[0], 1e-4)

    def _derivatives(
        self, at: Alignment, value: Callable[[Alignment], FloatArray], step: float
    ) -> FloatArray:
        """Central differences [k, p] of `value` [k] by the scaled free parameters."""
        columns = [
            (value(self.stepped(at, steps)) - value(self.stepped(at, -steps))) / (2 * step)
            for steps in step * np.eye(len(self.free))
        ]
        return np.stack(columns, axis=1)

    def covariance(self, best: Alignment, cost: float) -> FloatArray:
        """Covariance [p, p] of the free parameters; GeometryError when they are not determined.

        Scaled up where redundant measurements disagree by more than tape and pixel explain.
        """
        _, _, jacobian = self.linearised(best)
        if np.isnan(jacobian).any():
            raise GeometryError(
                "the best fit lies at the edge of the possible range: check the marks "
                "and their distances"
            )
        _, size, axes = np.linalg.svd(jacobian, full_matrices=False)
        limits = np.array([_LIMIT[name] for name in self.free])
        inverse = 1 / np.maximum(size, 1e-9)
        error = np.sqrt(((axes.T * inverse) ** 2).sum(axis=1))  # in scales
        if (error > limits).any():
            weak = np.abs(axes[-1] / limits)
            loose = [n for n, w in zip(self.free, weak, strict=True) if w > 0.3 * weak.max()]
            raise GeometryError(self._undetermined(loose, best, error))
        redundancy = self.count - len(self.free)
        scale = max(1.0, cost / redundancy) if redundancy > 0 else 1.0
        scales = np.array([best.scale(name) for name in self.free])
        basis = (axes.T * inverse) * scales[:, None]
        return np.asarray(scale * basis @ basis.T)

    def _undetermined(self, loose: list[str], best: Alignment, error: FloatArray) -> str:
        errors = dict(zip(self.free, error, strict=True))
        worst = max(loose, key=lambda name: errors[name])
        size = errors[worst] * best.scale(worst)
        doubt = f"{size:.2g}" if size < 1000 else "any"
        unit = {"m": " m", "deg": " degrees", "px": " px"}.get(worst.rpartition("_")[2], " px")
        text = (
            f"these marks do not tell {_names(loose)} apart"
            if len(loose) > 1
            else f"these marks do not determine the {_names(loose)}"
        ) + f" ({PARAMETER_NAMES[worst]} +/- {doubt}{unit}): "
        if set(loose) <= {"height_m", "pitch_deg"}:
            return text + "add marks nearer and farther, for example at 4 m and at 15 m"
        if loose == ["heading_deg"]:
            return text + "measure how far the marks lie to the right, or leave the heading out"
        optional = _names([n for n in loose if n not in ("height_m", "pitch_deg")])
        return text + (
            "add marks near, far and to both sides, with how far they lie to the right, or leave "
            f"{optional} as the calibration has it"
        )

    def check_unique(
        self, found: Sequence[tuple[float, float, Alignment]], error: dict[str, float]
    ) -> None:
        """Raises GeometryError when a different solution fits nearly as well as the best."""
        score, _, best = found[0]
        for other_score, _, other in found[1:]:
            apart = any(
                abs(getattr(other, name) - getattr(best, name))
                > max(6 * error[name], 0.3 * best.scale(name))
                for name in self.free
            )
            if apart and other_score < score + 4:
                one, two = (
                    " ".join(f"{PARAMETER_NAMES[n]} {getattr(x, n):.2f}" for n in self.free)
                    for x in (best, other)
                )
                raise GeometryError(
                    f"two solutions fit: {one} or {two}; add a mark at another distance"
                )

    def residuals(self, best: Alignment) -> tuple[Residual, ...]:
        """Each measurement beside the camera's reading."""
        value, slope = self.predict(best)
        expected = np.sqrt(np.diag(self.residual_covariance(slope)))
        return tuple(
            Residual(name, quantity, measured, float(read), float(sigma))
            for (name, quantity, _, _, measured), read, sigma in zip(
                self.rows, value, expected, strict=True
            )
        )

    def standard_error_at_10m(self, best: Alignment, covariance: FloatArray) -> float | None:
        """Standard error of the distance read at the pixel of a 10 m point; None: not in view."""
        pixel = pixel_at_distance(best.camera(self.like))
        if pixel is None:
            return None

        def reading(alignment: Alignment) -> FloatArray:
            return np.asarray(np.hypot(*alignment.camera(self.like).ground([pixel])[0].T))

        slope = self._derivatives(best, reading, 1e-3)[0]
        slope = slope / np.array([best.scale(name) for name in self.free])
        error_m = float(np.sqrt(slope @ covariance @ slope))
        return None if math.isnan(error_m) else error_m


def _measure(quantity: str, xy_m: FloatArray, other_m: FloatArray) -> FloatArray:
    """The measured quantity [5] of positions [5, 2]."""
    if quantity in ("forward", "right"):
        return np.asarray(xy_m[:, 0 if quantity == "forward" else 1])
    return np.asarray(np.hypot(*(xy_m - (other_m if quantity == "spacing" else 0)).T))


def _names(keys: Sequence[str]) -> str:
    """Names of parameters in a sentence: `height, pitch and radius`."""
    *most, last = (PARAMETER_NAMES[key] for key in keys)
    return f"{', '.join(most)} and {last}" if most else last
