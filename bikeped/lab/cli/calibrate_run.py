"""The work of `bikeped calibrate`, from files to files."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bikeped.cli.common import progress_bar, write_json
from bikeped.config import LoadedConfig, framing, load_config
from bikeped.errors import BikepedError
from bikeped.files import write_whole
from bikeped.geometry import canonical_projection
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.capture.coverage import measure_coverage
from bikeped.lab.calibration.capture.images import CalibrationImage, load_images
from bikeped.lab.calibration.image_pipeline import detect_boards
from bikeped.lab.calibration.report.calibration_file import calibration_data, write_calibration
from bikeped.lab.calibration.report.field_of_view import (
    brightest_pixels,
    circle_radius_px,
    field_of_view,
)
from bikeped.lab.calibration.report.results import (
    CalibrationResult,
    calibration_cautions,
    result_data,
)
from bikeped.lab.calibration.solver.lens_model import LensModel
from bikeped.lab.calibration.solver.model_comparison import (
    comparison_models,
    fit_models,
    recommend_model,
)
from bikeped.lab.calibration.solver.observations import prepare_observations

_CIRCLE_IMAGES = 16  # enough to see the image circle


@dataclass(frozen=True)
class CalibrateOptions:
    """Board and models; `model` and `terms` None: as `--compare` recommends, or the defaults."""

    pattern: BoardPattern
    model: str | None
    terms: int | None
    board_shape: bool
    compare: bool
    folds: int  #: 0: each image is a fold

    @property
    def writes_recommended(self) -> bool:
        """Whether the recommended model is written."""
        open_model = self.model is None and self.terms is None and not self.board_shape
        return self.compare and open_model


def run(
    images: Sequence[CalibrationImage], options: CalibrateOptions, loaded: LoadedConfig
) -> CalibrationResult:
    """From images to fits; CalibrationError, with the remedy, where they give no lens."""
    size = (images[0].width, images[0].height)
    sensor = framing(loaded)
    framed = sensor if size == (sensor.sensor_w, sensor.sensor_h) else None
    with progress_bar("boards", len(images)) as progress:
        boards = detect_boards(images, options.pattern, framed, progress=progress)
    prepared = prepare_observations(boards)
    projection = canonical_projection(options.model or "equidistant")
    terms = 4 if options.terms is None else options.terms
    model = LensModel(projection, terms, options.board_shape)
    models = comparison_models(model) if options.compare else [model]
    with progress_bar("models", len(models)) as progress:
        comparison = fit_models(prepared, models, options.folds, progress)
    recommendation = recommend_model(comparison)
    chosen = comparison.fits[recommendation.name if options.writes_recommended else model.name]
    some = images[:: max(1, len(images) // _CIRCLE_IMAGES)][:_CIRCLE_IMAGES]
    bright = brightest_pixels(image.grey() for image in some)
    offset = (0, 0) if framed is None else framed.offset_px
    window = (0.0, 0.0, float(size[0]), float(size[1])) if framed is None else framed.window_px
    circle_px = circle_radius_px(bright, chosen.state.lens[:2] - offset)
    field = field_of_view(chosen, circle_px, window)
    views, centre = prepared.observations.views(), (chosen.cx, chosen.cy)
    return CalibrationResult(
        comparison,
        chosen,
        recommendation,
        field,
        measure_coverage(views, chosen.lens(field.half_rad), centre, window),
        [
            *calibration_cautions(prepared, chosen, field),
            *_configuration_cautions(loaded, size, framed is not None),
        ],
        framed,
    )


def write_outputs(
    result: CalibrationResult,
    images: Sequence[CalibrationImage],
    report: Path | None,
    json_path: str | None,
    out: Path | None,
    default_out: Path,
) -> list[str]:
    """Writes all outputs, computed before the first is written; one line about each."""
    prepared = result.comparison.prepared
    lens = calibration_data(prepared, result.chosen, result.field, result.framing)
    page = "" if report is None else _report(result, images)
    lines = []
    if report is not None:
        write_whole(report, page)
        lines.append(f"wrote {report}")
    if json_path is not None:
        write_json(result_data(result), json_path)
        if json_path != "-":
            lines.append(f"wrote {json_path}")
    target = out or default_out
    if out is None and default_out.exists():
        text = f"{target} exists and was left as it is; --out {target} replaces it"
        return [*lines, text]
    kept = write_calibration(target, lens)
    return [*lines, f"wrote {target}" + (f"; the former one is {kept}" if kept else "")]


def _report(result: CalibrationResult, images: Sequence[CalibrationImage]) -> str:
    from bikeped.lab.calibration.report.board_images import Thumbnail
    from bikeped.lab.calibration.report.html_report import report_page

    offset = (0, 0) if result.framing is None else result.framing.offset_px
    return report_page(result, [Thumbnail(image.name, image.grey(), offset) for image in images])


def images_of(paths: Sequence[Path]) -> list[CalibrationImage]:
    """The images of the command line; BikepedError where none are named."""
    if not paths:
        raise BikepedError(
            "IMAGES: missing; name pictures of the board, a folder of them or a video, or use "
            "--live"
        )
    return load_images(paths)


def camera_config(config_path: Path | None, overrides: tuple[str, ...]) -> LoadedConfig:
    """The configuration with a stand-in for its calibration file, which may not exist yet."""
    with tempfile.TemporaryDirectory() as folder:
        stand_in = Path(folder) / "stand-in.json"
        stand_in.write_text(
            '{"model": "equidistant", "cx": 0, "cy": 0, "focal_length": 1, "fov_deg": 180}'
        )
        return load_config(config_path, (*overrides, f"camera.calibration={stand_in}"))


def _configuration_cautions(loaded: LoadedConfig, size: tuple[int, int], framed: bool) -> list[str]:
    """Settings to change before the new file can be used."""
    camera = loaded.config.camera
    if not framed:
        caution = (
            f"the pictures are {size[0]} x {size[1]}, the camera in {loaded.source} {camera.width} "
            f"x {camera.height}: to use the file, set camera.width: {size[0]}, camera.height: "
            f"{size[1]}, and camera.pad_size and camera.crop_size to null"
        )
        return [caution]
    keys = ("projection", "fov_deg", "radius_px", "cx", "cy", "k1", "k2", "k3", "k4")
    given = ", ".join(f"camera.{key}" for key in keys if getattr(camera, key) is not None)
    override = "which override the file; set them to null to use the measured lens"
    return [f"{loaded.source} sets {given}, {override}"] if given else []
