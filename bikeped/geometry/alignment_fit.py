"""How a camera hangs, from marks on the ground whose distances were measured with a tape.

Least squares over the deployed geometry itself (`GroundCamera.ground`): each measurement is held
against what the camera reads at the mark's pixel. Near the horizon a pixel is tens of centimetres
on the ground, so errors are weighted by what tape and finger can do: the covariance of the
differences is tape^2 I + px^2 G G^T, G being how each reading moves with the pixels of the marks
(first-order orthogonal distance regression; Boggs and Rogers 1990). Levenberg-Marquardt from the
start values and from a fan of pitches, so a wrong start does not matter. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bikeped.errors import GeometryError
from bikeped.geometry.alignment import (
    PARAMETERS,
    Accuracy,
    Alignment,
    Fit,
    Mark,
    Residual,
    Spacing,
    reading_m,
    ten_metre_pixel,
)
from bikeped.geometry.camera import GroundCamera
from bikeped.types import FloatArray

#: A standard error beyond this many units means that the marks do not determine the number.
_LIMIT = {"height_m": 3.0, "pitch_deg": 2.0, "radius_px": 3.0, "cx": 4.0, "cy": 4.0}
_LIMIT_HEADING = 5.0
_STEPS = 60


def fit(
    camera: GroundCamera,
    marks: Sequence[Mark],
    spacings: Sequence[Spacing] = (),
    free: Sequence[str] = ("height_m", "pitch_deg"),
    accuracy: Accuracy | None = None,
) -> Fit:
    """The alignment that explains the measurements best; what is not `free` stays `camera`'s.

    Raises GeometryError, saying what to measure, when the marks do not determine the answer.
    """
    unknown = [name for name in free if name not in PARAMETERS]
    if unknown or not free or len(set(free)) < len(free):
        raise GeometryError(
            f"free: {', '.join(unknown) or 'nothing, or a name twice'}; use some of "
            f"{', '.join(PARAMETERS)}"
        )
    problem = _Problem(camera, marks, spacings, tuple(free), accuracy or Accuracy())
    problem.check()
    ends = [problem.descend(start) for start in problem.starts()]
    found = sorted(((*problem.costs(end), end) for end in ends), key=lambda answer: answer[0])
    if not found:
        raise GeometryError(
            "no pitch puts every mark on the ground: is each on flat ground, below the horizon, "
            "and set where it lies in the picture?"
        )
    _, cost, best = found[0]
    covariance = problem.covariance(best, cost)
    error = dict(zip(free, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    problem.check_single([(score, end) for score, _, end in found], error)
    answer = Fit(
        alignment=best,
        error=error,
        residuals=problem.residuals(best),
        spare=problem.count - len(free),
        at_10m_error_m=problem.at_10m_error(best, covariance),
    )
    if not answer.strange:
        return answer
    return replace(answer, suspect=_suspect(problem, spacings, cost))


def _suspect(problem: _Problem, spacings: Sequence[Spacing], cost: float) -> str | None:
    """The mark without which the others agree; least squares smears its fault over all of them."""
    marks, found = problem.marks, []
    for i, mark in enumerate(marks):
        kept = [
            Spacing(s.first - (s.first > i), s.second - (s.second > i), s.distance_m)
            for s in spacings
            if i not in (s.first, s.second)
        ]
        rest = [*marks[:i], *marks[i + 1 :]]
        less = _Problem(problem.like, rest, kept, problem.free, problem.accuracy)
        if less.count > len(problem.free):
            squares = (less.costs(less.descend(start))[1] for start in less.starts())
            found.append((min(squares, default=math.inf), mark.name))
    best = min(found, default=(math.inf, ""))
    return best[1] if best[0] < 0.2 * cost else None


class _Problem:
    """Marks and spacings as a system of equations."""

    def __init__(
        self,
        camera: GroundCamera,
        marks: Sequence[Mark],
        spacings: Sequence[Spacing],
        free: tuple[str, ...],
        accuracy: Accuracy,
    ) -> None:
        self.like, self.marks, self.free, self.accuracy = camera, marks, free, accuracy
        self.uv_px = np.array([[m.u_px, m.v_px] for m in marks], np.float64).reshape(-1, 2)
        rows: list[tuple[str, str, int, int, float]] = []
        for i, mark in enumerate(marks):
            for what in ("distance", "forward", "right"):
                value = getattr(mark, f"{what}_m")
                if value is not None:
                    rows.append((mark.name, what, i, i, float(value)))
        for spacing in spacings:
            i, j = spacing.first, spacing.second
            if not (0 <= i < len(marks) and 0 <= j < len(marks)) or i == j:
                raise GeometryError("spacings: name two different marks that are there")
            if not (math.isfinite(spacing.distance_m) and spacing.distance_m > 0):
                raise GeometryError(
                    f"spacing {marks[i].name}-{marks[j].name}: {spacing.distance_m:g} must be "
                    "above 0"
                )
            rows.append((f"{marks[i].name}-{marks[j].name}", "spacing", i, j, spacing.distance_m))
        self.rows = rows
        self.measured_m = np.array([row[4] for row in rows])

    @property
    def count(self) -> int:
        """Measurements."""
        return len(self.rows)

    def check(self) -> None:
        """Raises GeometryError for what no descent can mend."""
        if self.count < len(self.free):
            names = _names(self.free)
            raise GeometryError(
                f"{self.count} measurement{'s' * (self.count != 1)} cannot determine "
                f"{len(self.free)} numbers ({names}): add "
                f"{len(self.free) - self.count} more, better two or three"
            )
        for i, mark in enumerate(self.marks):
            for other in self.marks[:i]:
                if math.hypot(mark.u_px - other.u_px, mark.v_px - other.v_px) < 1:
                    raise GeometryError(
                        f"marks {other.name} and {mark.name} are the same pixel; move or delete one"
                    )
        if "radius_px" not in self.free and "cx" not in self.free and "cy" not in self.free:
            dark = np.isnan(self.like.rays(self.uv_px)).any(axis=1)
            if dark.any():
                raise GeometryError(
                    f"mark {self.marks[int(np.argmax(dark))].name} lies outside the image circle; "
                    "move it, or correct radius and centre first"
                )

    def read(self, alignment: Alignment) -> tuple[FloatArray, FloatArray] | None:
        """What the camera reads for each row [m], and how it moves with each pixel [m, 2n].

        None when a mark is not on the ground, or the numbers make no camera.
        """
        try:
            camera = alignment.camera(self.like)
        except GeometryError:
            return None
        step = 0.25
        around = step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        xy, valid = camera.ground(self.uv_px[:, None, :] + around)
        if not valid.all():
            return None
        n = len(self.marks)
        value = np.empty(self.count)
        slope = np.zeros((self.count, 2 * n))
        for row, (_, what, i, j, _) in enumerate(self.rows):
            for k, other in ((i, j), (j, i)) if what == "spacing" else ((i, i),):
                reads = _measure(what, xy[k], xy[other, 0])
                value[row] = reads[0]
                slope[row, 2 * k] = (reads[1] - reads[2]) / (2 * step)
                slope[row, 2 * k + 1] = (reads[3] - reads[4]) / (2 * step)
        return value, slope

    def spread(self, slope: FloatArray) -> FloatArray:
        """Covariance [m, m] of the differences, from tape and pixel."""
        tape, mark = self.accuracy.tape_m, self.accuracy.mark_px
        return np.asarray(tape**2 * np.eye(self.count) + mark**2 * slope @ slope.T)

    def starts(self) -> list[Alignment]:
        """The camera's own numbers, and a fan of pitches (and headings), best first, at most four.

        Positions grow in proportion to the height, so each pitch has its height at once.
        """
        own = Alignment.of(self.like)
        fan = [own]
        pitches = range(-85, 45, 5) if "pitch_deg" in self.free else [own.pitch_deg]
        headings = range(-180, 180, 45) if "heading_deg" in self.free else [0]
        fan += [
            replace(own, pitch_deg=float(pitch), heading_deg=own.heading_deg + turn)
            for pitch in pitches
            for turn in headings
        ]
        found = []
        for start in fan:
            answer = self.read(start)
            if answer is None:
                continue
            if "height_m" in self.free:
                size = float(answer[0] @ answer[0])
                share = float(answer[0] @ self.measured_m) / size if size > 0 else 1.0
                height_m = start.height_m * share
                if 0.1 < height_m <= 100:
                    start = replace(start, height_m=height_m)
            found.append((self.costs(start)[0], start))
        found.sort(key=lambda answer: answer[0])
        return [start for score, start in found[:4] if math.isfinite(score)]

    def costs(self, alignment: Alignment) -> tuple[float, float]:
        """Minus twice the log likelihood (but for a constant), and the weighted sum of squares.

        Two places are compared by the likelihood: near the horizon nothing is precise, and every
        sum of squares small. Infinite where there is no answer.
        """
        answer = self.read(alignment)
        if answer is None:
            return math.inf, math.inf
        off, spread = answer[0] - self.measured_m, self.spread(answer[1])
        squares = float(off @ np.linalg.solve(spread, off))
        return squares + float(np.linalg.slogdet(spread)[1]), squares

    def descend(self, start: Alignment) -> Alignment:
        """Where Levenberg-Marquardt ends, with weights that follow the estimate.

        Weights are held during a step: were they part of the cost, it could be lowered by moving
        marks toward the horizon, where nothing is precise.
        """
        here, damping = start, 1e-3
        for _ in range(_STEPS):
            answer = self.read(here)
            if answer is None:
                break
            weight = np.linalg.inv(np.linalg.cholesky(self.spread(answer[1])))
            off = weight @ (answer[0] - self.measured_m)
            slope = self.slopes(here)
            if slope is None:
                break
            slope = weight @ slope
            normal, pull = slope.T @ slope, slope.T @ off
            while damping < 1e9:
                damped = normal + damping * np.diag(np.diag(normal) + 1e-12)
                step = -np.linalg.solve(damped, pull)
                there = self.moved(here, np.clip(step, -10, 10))
                tried = self.read(there)
                if tried is not None:
                    now = weight @ (tried[0] - self.measured_m)
                    if now @ now <= off @ off:
                        break
                damping *= 4
            else:
                break
            damping = max(damping / 10, 1e-12)
            here = there
            if float(np.abs(step).max()) < 1e-9:
                break
        return here

    def moved(self, alignment: Alignment, units: FloatArray) -> Alignment:
        """The alignment some units of each free parameter away."""
        to = {
            name: getattr(alignment, name) + float(by) * alignment.unit(name)
            for name, by in zip(self.free, units, strict=True)
        }
        return replace(alignment, **to)

    def slopes(self, alignment: Alignment) -> FloatArray | None:
        """How the readings move with a unit of each free parameter [m, p], by differences."""
        columns = []
        for k in range(len(self.free)):
            step = np.zeros(len(self.free))
            step[k] = 1e-4
            up = self.read(self.moved(alignment, step))
            down = self.read(self.moved(alignment, -step))
            if up is None or down is None:
                return None
            columns.append((up[0] - down[0]) / 2e-4)
        return np.stack(columns, axis=1)

    def covariance(self, best: Alignment, cost: float) -> FloatArray:
        """Covariance of the free parameters; GeometryError when they are not determined.

        Larger than tape and pixel say where the spare measurements disagree by more than that.
        """
        answer, slope = self.read(best), self.slopes(best)
        if answer is None or slope is None:
            raise GeometryError(
                "the best answer lies at the edge of what is possible: check the marks "
                "and their distances"
            )
        weight = np.linalg.inv(np.linalg.cholesky(self.spread(answer[1])))
        _, size, axes = np.linalg.svd(weight @ slope, full_matrices=False)
        limits = np.array([_LIMIT.get(name, _LIMIT_HEADING) for name in self.free])
        inverse = 1 / np.maximum(size, 1e-9)
        error = np.sqrt(((axes.T * inverse) ** 2).sum(axis=1))  # in units
        if (error > limits).any():
            weak = np.abs(axes[-1] / limits)
            loose = [n for n, w in zip(self.free, weak, strict=True) if w > 0.3 * weak.max()]
            raise GeometryError(self._undetermined(loose, best, error))
        spare = self.count - len(self.free)
        scale = max(1.0, cost / spare) if spare > 0 else 1.0
        units = np.array([best.unit(name) for name in self.free])
        basis = (axes.T * inverse) * units[:, None]
        return np.asarray(scale * basis @ basis.T)

    def _undetermined(self, loose: list[str], best: Alignment, error: FloatArray) -> str:
        by = dict(zip(self.free, error, strict=True))
        worst = max(loose, key=lambda name: by[name])
        size = by[worst] * best.unit(worst)
        doubt = f"{size:.2g}" if size < 1000 else "any"
        unit = {"m": " m", "deg": " degrees", "px": " px"}.get(worst.rpartition("_")[2], " px")
        if len(loose) > 1:
            said = f"these marks do not tell {_names(loose)} apart"
        else:
            said = f"these marks do not determine the {PARAMETERS[loose[0]]}"
        said += f" ({PARAMETERS[worst]} +/- {doubt}{unit}): "
        if set(loose) <= {"height_m", "pitch_deg"}:
            return said + "add marks nearer and farther, for example at 4 m and at 15 m"
        if loose == ["heading_deg"]:
            return said + "measure how far the marks lie to the right, or leave the heading out"
        return said + (
            "add marks near, far and to both sides, with how far they lie to the right, or leave "
            f"{' and '.join(PARAMETERS[n] for n in loose if n not in ('height_m', 'pitch_deg'))} "
            "as the calibration has it"
        )

    def check_single(
        self, found: Sequence[tuple[float, Alignment]], error: dict[str, float]
    ) -> None:
        """Raises GeometryError when another answer fits (nearly) as well as the best."""
        score, best = found[0]
        for other_score, other in found[1:]:
            apart = any(
                abs(getattr(other, name) - getattr(best, name))
                > max(6 * error[name], 0.3 * best.unit(name))
                for name in self.free
            )
            if apart and other_score < score + 4:
                raise GeometryError(
                    f"two answers fit: {_said(best, self.free)}, or {_said(other, self.free)}; "
                    "add a mark at another distance"
                )

    def residuals(self, best: Alignment) -> tuple[Residual, ...]:
        """Each measurement beside what the camera reads."""
        answer = self.read(best)
        if answer is None:  # checked by `covariance`
            return ()
        expected = np.sqrt(np.diag(self.spread(answer[1])))
        return tuple(
            Residual(name, what, measured, float(read), float(may))
            for (name, what, _, _, measured), read, may in zip(
                self.rows, answer[0], expected, strict=True
            )
        )

    def at_10m_error(self, best: Alignment, covariance: FloatArray) -> float | None:
        """Standard error of the distance that the pixel of a 10 m mark reads."""
        pixel = ten_metre_pixel(best.camera(self.like))
        if pixel is None:
            return None
        slope = np.zeros(len(self.free))
        for k, name in enumerate(self.free):
            step = np.zeros(len(self.free))
            step[k] = 1e-3
            up = reading_m(self.moved(best, step).camera(self.like), pixel)
            down = reading_m(self.moved(best, -step).camera(self.like), pixel)
            if up is None or down is None:
                return None
            slope[k] = (up - down) / 2e-3 / best.unit(name)
        return float(np.sqrt(slope @ covariance @ slope))


def _measure(what: str, xy_m: FloatArray, other_m: FloatArray) -> FloatArray:
    """What a tape would say of positions [5, 2]."""
    if what == "distance":
        return np.asarray(np.hypot(xy_m[:, 0], xy_m[:, 1]))
    if what == "spacing":
        return np.asarray(np.hypot(xy_m[:, 0] - other_m[0], xy_m[:, 1] - other_m[1]))
    return np.asarray(xy_m[:, 0 if what == "forward" else 1])


def _names(names: Sequence[str]) -> str:
    said = [PARAMETERS[name] for name in names]
    return said[0] if len(said) == 1 else f"{', '.join(said[:-1])} and {said[-1]}"


def _said(alignment: Alignment, names: Sequence[str]) -> str:
    return " ".join(f"{PARAMETERS[name]} {getattr(alignment, name):.2f}" for name in names)
