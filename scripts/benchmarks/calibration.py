"""Calibration: the fit in blocks beside scipy's least_squares on the whole, and the whole run."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from benchmarks.figures import Figures
    from bikeped.lab.calibration.board_view import BoardView
    from bikeped.lab.calibration.solver.lens_model import (
        CalibrationState,
        CornerObservations,
        LensModel,
    )

_PICTURES = Path(__file__).parents[3] / "shared" / "media" / "fisheye-checkerboard"
_RUNS = 3
sys.path.append(str(Path(__file__).parents[2] / "tests"))  # the drawn boards with known truth


def run(figures: Figures) -> None:
    from bikeped.lab.calibration.board_view import BoardPattern
    from bikeped.lab.calibration.solver.bundle_adjustment import adjust
    from bikeped.lab.calibration.solver.initial_guess import first_guess
    from bikeped.lab.calibration.solver.lens_model import CornerObservations, LensModel

    pattern = BoardPattern(8, 6)
    model = LensModel("equidistant", 4)
    small = CornerObservations.of(pattern, _boards(15, 1000, 190.0))
    start = first_guess(small)
    ours = _median(lambda: adjust(small, model, first_guess(small)))
    obvious = _median(lambda: _dense(small, start), 1)
    figures.add("fit of 15 boards from nothing, k1..k4", ours, obvious, "s", "< 0.2 s")
    large = CornerObservations.of(pattern, _boards(42, 3500, 200.0))
    start = first_guess(large)
    ours = _median(lambda: adjust(large, model, first_guess(large)))
    obvious = _median(lambda: _dense(large, start), 1)
    figures.add("fit of 42 boards from nothing, k1..k4", ours, obvious, "s")
    _whole(figures)


def _boards(count: int, size: int, fov_deg: float) -> list[BoardView]:
    from synthetic_boards import DrawnCamera, draw_views, spread_poses

    from bikeped.geometry import Lens
    from bikeped.lab.calibration.board_view import BoardPattern

    pattern = BoardPattern(8, 6)
    lens = Lens.from_circle("equidistant", size / 2, fov_deg, (0.003, -0.008, 0.002, -0.0004))
    camera = DrawnCamera(lens, size / 2 + 2, size / 2 + 9, size, size)
    return draw_views(camera, pattern, spread_poses(camera, pattern, count), noise_px=0.3)


def _dense(observations: CornerObservations, start: CalibrationState) -> None:
    """The obvious way: all parameters in one vector, numeric Jacobian, the same two stages."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    from bikeped.lab.calibration.solver.lens_model import CalibrationState, residuals, rotations

    views = len(observations)
    first = np.concatenate(
        [
            start.lens,
            np.zeros(4),
            Rotation.from_matrix(start.rotation).as_rotvec().ravel(),
            start.translation.ravel(),
        ]
    )

    def errors(x: np.ndarray) -> np.ndarray:
        state = CalibrationState(
            "equidistant",
            x[:7],
            rotations(x[7 : 7 + 3 * views].reshape(-1, 3)),
            x[7 + 3 * views :].reshape(-1, 3),
            start.shape,
        )
        return residuals(state, observations).ravel()

    plain = least_squares(errors, first, x_scale="jac")
    least_squares(errors, plain.x, x_scale="jac", loss="soft_l1", f_scale=0.9)


def large(figures: Figures) -> None:
    """42 drawn pictures of 3500 x 3500 through a 200 degree lens; drawing them takes a minute."""
    import cv2
    from board_render import RenderStyle, draw_picture
    from synthetic_boards import DrawnCamera, spread_poses

    from bikeped.geometry import Lens
    from bikeped.lab.calibration.board_view import BoardPattern
    from bikeped.lab.calibration.solver.lens_model import LensModel
    from bikeped.lab.calibration.solver.model_comparison import comparison_models

    pattern = BoardPattern(8, 6)
    lens = Lens.from_circle("equidistant", 1750, 200.0)
    camera = DrawnCamera(lens, 1752.7, 1804.5, 3500, 3500)
    with tempfile.TemporaryDirectory() as folder:
        files = []
        for number, pose in enumerate(spread_poses(camera, pattern, 42, seed=1)):
            picture = draw_picture(camera, pattern, pose, style=RenderStyle(samples=1), seed=number)
            files.append(Path(folder) / f"board{number:02d}.jpg")
            cv2.imwrite(str(files[-1]), picture)
        models = comparison_models(LensModel("equidistant", 4))
        taken = _median(_work(files, models), 1)
        figures.add("42 drawn pictures of 3500 px, --compare", taken, None, "s", "< 30 s")


def _work(paths: list[Path], models: list[LensModel]) -> Callable[[], object]:
    """Pictures to recommendation, in this process: what `bikeped calibrate` does after start-up."""
    from bikeped.lab.calibration.board_view import BoardPattern
    from bikeped.lab.calibration.capture.images import load_images
    from bikeped.lab.calibration.image_pipeline import detect_boards
    from bikeped.lab.calibration.solver.model_comparison import fit_models, recommend_model
    from bikeped.lab.calibration.solver.observations import prepare_observations

    def work() -> object:
        boards = detect_boards(load_images(paths), BoardPattern(8, 6))
        return recommend_model(fit_models(prepare_observations(boards), models, 0))

    return work


def _whole(figures: Figures) -> None:
    from bikeped.lab.calibration.solver.lens_model import LensModel
    from bikeped.lab.calibration.solver.model_comparison import comparison_models

    files = sorted(_PICTURES.glob("*.jpg"))
    if files:
        one, all_ = [LensModel("equidistant", 4)], comparison_models(LensModel("equidistant", 4))
        figures.add("15 real pictures, one model", _median(_work(files, one)), None, "s", "< 1 s")
        figures.add("15 real pictures, --compare", _median(_work(files, all_)), None, "s", "< 1 s")


def _median(work: Callable[[], object], runs: int = _RUNS) -> float:
    """Median seconds after one warm-up (none for a single run, which takes seconds)."""
    if runs > 1:
        work()
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return float(np.median(times))
