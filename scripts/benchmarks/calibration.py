"""Calibration: the fit in blocks beside scipy's least_squares on the whole, and the whole run."""

from __future__ import annotations

import functools
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.figures import Figures, median_s
from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern, BoardView
from bikeped.lab.calibration.capture.images import load_images
from bikeped.lab.calibration.image_pipeline import detect_boards
from bikeped.lab.calibration.solver.bundle_adjustment import adjust
from bikeped.lab.calibration.solver.lens_model import (
    CalibrationState,
    CornerObservations,
    LensModel,
    residuals,
    rotations,
)
from bikeped.lab.calibration.solver.model_comparison import (
    comparison_models,
    fit_models,
    recommend_model,
)
from bikeped.lab.calibration.solver.observations import first_guess, prepare_observations

_PICTURES = Path(__file__).parents[3] / "shared" / "media" / "fisheye-checkerboard"
_PATTERN = BoardPattern(8, 6)
sys.path.append(str(Path(__file__).parents[2] / "tests"))  # the drawn boards with known truth


def run(figures: Figures) -> None:
    model = LensModel("equidistant", 4)
    for views, goal in ((_boards(15, 1000, 190.0), "< 0.2 s"), (_boards(42, 3500, 200.0), "")):
        boards = CornerObservations.of(_PATTERN, views)
        ours = functools.partial(_fit, boards, model)
        obvious = functools.partial(_dense, boards, first_guess(boards))
        what = f"fit of {len(views)} boards from nothing, k1..k4"
        figures.add(what, median_s(ours, 3), median_s(obvious, 1), "s", goal)
    files = sorted(_PICTURES.glob("*.jpg"))
    if files:
        for what, models in (("one model", [model]), ("--compare", comparison_models(model))):
            taken = median_s(_work(files, models), 3)
            figures.add(f"15 real pictures, {what}", taken, None, "s", "< 1 s")


def _boards(count: int, size: int, fov_deg: float) -> list[BoardView]:
    from synthetic_boards import DrawnCamera, draw_views, spread_poses

    lens = Lens.from_circle("equidistant", size / 2, fov_deg, (0.003, -0.008, 0.002, -0.0004))
    camera = DrawnCamera(lens, size / 2 + 2, size / 2 + 9, size, size)
    return draw_views(camera, _PATTERN, spread_poses(camera, _PATTERN, count), noise_px=0.3)


def _fit(observations: CornerObservations, model: LensModel) -> None:
    adjust(observations, model, first_guess(observations))


def _dense(observations: CornerObservations, start: CalibrationState) -> None:
    """The obvious way: all parameters in one vector, numeric Jacobian, the same two stages."""
    views = len(observations)
    turns = Rotation.from_matrix(start.rotation).as_rotvec()
    first = np.concatenate([start.lens, np.zeros(4), turns.ravel(), start.translation.ravel()])

    def errors(x: np.ndarray) -> np.ndarray:
        turn, shift = x[7:].reshape(2, views, 3)
        state = CalibrationState("equidistant", x[:7], rotations(turn), shift, start.shape)
        return residuals(state, observations).ravel()

    plain = least_squares(errors, first, x_scale="jac")
    least_squares(errors, plain.x, x_scale="jac", loss="soft_l1", f_scale=0.9)


def large(figures: Figures) -> None:
    """42 drawn pictures of 3500 x 3500 through a 200 degree lens; drawing them takes a minute."""
    from board_render import RenderStyle, draw_picture
    from synthetic_boards import DrawnCamera, spread_poses

    lens = Lens.from_circle("equidistant", 1750, 200.0)
    camera = DrawnCamera(lens, 1752.7, 1804.5, 3500, 3500)
    with tempfile.TemporaryDirectory() as folder:
        files = []
        for number, pose in enumerate(spread_poses(camera, _PATTERN, 42, seed=1)):
            picture = draw_picture(
                camera, _PATTERN, pose, style=RenderStyle(samples=1), seed=number
            )
            files.append(Path(folder) / f"board{number:02d}.jpg")
            cv2.imwrite(str(files[-1]), picture)
        models = comparison_models(LensModel("equidistant", 4))
        taken = median_s(_work(files, models), 1)
        figures.add("42 drawn pictures of 3500 px, --compare", taken, None, "s", "< 30 s")


def _work(paths: list[Path], models: list[LensModel]) -> Callable[[], object]:
    """Pictures to recommendation, in this process: what `bikeped calibrate` does after start-up."""

    def work() -> object:
        boards = detect_boards(load_images(paths), _PATTERN)
        return recommend_model(fit_models(prepare_observations(boards), models, 0))

    return work
