"""The work of `bikeped calibrate`, from files to files."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bikeped.cli.common import progress_bar, write_json
from bikeped.config import LoadedConfig, framing, load_config
from bikeped.errors import BikepedError
from bikeped.files import write_whole
from bikeped.geometry import Framing, canonical_projection
from bikeped.lab.calibration.board_view import BoardPattern, Found
from bikeped.lab.calibration.capture.coverage import Coverage, cover
from bikeped.lab.calibration.capture.pictures import Picture, load_pictures
from bikeped.lab.calibration.corners.find_boards import find_boards
from bikeped.lab.calibration.report.calibration_file import (
    Field,
    calibration_data,
    field_of_view,
    write_calibration,
)
from bikeped.lab.calibration.report.results import cautions_of, result_data
from bikeped.lab.calibration.solver.compare import (
    Calibrated,
    Recommendation,
    calibrate,
    models_to_compare,
    recommend,
)
from bikeped.lab.calibration.solver.image_circle import brightest, circle_radius_px
from bikeped.lab.calibration.solver.lens_fit import Fit
from bikeped.lab.calibration.solver.lens_model import Model
from bikeped.lab.calibration.solver.observations import cropped, prepare
from bikeped.lab.cli.calibrate_options import Asked

_CIRCLE_PICTURES = 16


@dataclass(frozen=True)
class Done:
    """Everything that a run found out."""

    asked: Asked
    pictures: list[Picture]
    calibrated: Calibrated
    chosen: Fit
    recommendation: Recommendation
    field: Field
    framing: Framing | None  #: of sensor frames; None: pictures as they are
    coverage: Coverage
    cautions: tuple[str, ...]

    @property
    def data(self) -> dict[str, Any]:
        """The JSON of the command."""
        data = result_data(self.calibrated, self.chosen, self.recommendation, list(self.cautions))
        data["coverage"] = {"share": self.coverage.share, "next": self.coverage.advice()}
        return data

    def write(
        self, report: Path | None, json_path: str | None, out: Path | None, default_out: Path
    ) -> list[str]:
        """Writes what was asked for, all of it computed first; lines for people on what it did."""
        lens = calibration_data(self.calibrated, self.chosen, self.field, self.framing)
        page = self._page() if report is not None else ""
        lines = []
        if report is not None:
            write_whole(report, page)
            lines.append(f"wrote {report}")
        if json_path is not None:
            write_json(self.data, json_path)
            if json_path != "-":
                lines.append(f"wrote {json_path}")
        target = out or default_out
        if out is None and default_out.exists():
            return [
                *lines,
                f"{default_out} exists and was left as it is; --out {default_out} replaces it",
            ]
        kept = write_calibration(target, lens)
        lines.append(f"wrote {target}" + (f"; the former one is {kept}" if kept else ""))
        return lines

    def _page(self) -> str:
        from bikeped.lab.calibration.report.board_images import Thumbnail
        from bikeped.lab.calibration.report.html_report import Told, report_page

        offset = (0, 0) if self.framing is None else self.framing.offset_px
        told = Told(
            self.calibrated,
            self.chosen,
            self.recommendation,
            self.field,
            self.cautions,
            self.coverage.advice() or ["nothing: every part of the circle has been seen"],
            [(p.from_rad, p.to_rad, p.start_rad, p.stop_rad) for p in self.coverage.gaps],
        )
        return report_page(told, [Thumbnail(p.name, p.grey(), offset) for p in self.pictures])


def run(
    images: Sequence[Path],
    asked: Asked,
    config_path: Path | None,
    overrides: tuple[str, ...],
) -> Done:
    """From pictures to fits; CalibrationError or BikepedError with the mend."""
    if not images:
        raise BikepedError(
            "IMAGES: missing; name pictures of the board, a folder of them or a video, or use "
            "--live"
        )
    loaded = camera_config(config_path, overrides)
    pictures = load_pictures(images)
    found = _boards(pictures, asked.pattern)
    sensor = framing(loaded)
    size = (pictures[0].width, pictures[0].height)
    framed = sensor if size == (sensor.sensor_w, sensor.sensor_h) else None
    if framed is not None:
        found = cropped(found, framed)
    prepared = prepare(found)
    models = _models(asked)
    with progress_bar("models", len(models)) as progress:
        calibrated = calibrate(prepared, models, asked.folds, progress)
    recommendation = recommend(calibrated)
    chosen = calibrated.fits[recommendation.name if asked.free_to_choose else _chosen(asked).name]
    bright = brightest(picture.grey() for picture in _some(pictures))
    offset = (0, 0) if framed is None else framed.offset_px
    centre = chosen.state.lens[:2] - offset
    window = (0.0, 0.0, float(size[0]), float(size[1])) if framed is None else framed.window_px
    field = field_of_view(chosen, circle_radius_px(bright, centre), window)
    lens = chosen.lens(field.half_rad)
    coverage = cover(prepared.sightings.views(), lens, (chosen.cx, chosen.cy), window)
    cautions = [
        *cautions_of(calibrated, chosen, field),
        *_use(loaded, size, framed is not None),
    ]
    return Done(
        asked,
        pictures,
        calibrated,
        chosen,
        recommendation,
        field,
        framed,
        coverage,
        tuple(cautions),
    )


def _boards(pictures: list[Picture], pattern: BoardPattern) -> Found:
    """The boards, with a bar on a terminal."""
    count = itertools.count(1)
    with progress_bar("boards", len(pictures)) as progress:
        return find_boards(pictures, pattern, progress=lambda _: progress(next(count)))


def camera_config(config_path: Path | None, overrides: tuple[str, ...]) -> LoadedConfig:
    """The configuration, with a stand-in for its calibration file: that one may not exist yet, or
    not fit, which is why a person calibrates."""
    with tempfile.TemporaryDirectory() as folder:
        stand_in = Path(folder) / "stand-in.json"
        stand_in.write_text(
            '{"model": "equidistant", "cx": 0, "cy": 0, "focal_length": 1, "fov_deg": 180}'
        )
        return load_config(config_path, (*overrides, f"camera.calibration={stand_in}"))


def _use(loaded: LoadedConfig, size: tuple[int, int], framed: bool) -> list[str]:
    """What stands between the new file and the service."""
    camera = loaded.config.camera
    if not framed:
        text = (
            f"the pictures are {size[0]} x {size[1]}, the camera in {loaded.source} {camera.width} "
            f"x {camera.height}: to use the file, set camera.width: {size[0]}, camera.height: "
            f"{size[1]}, and camera.pad_size and camera.crop_size to null"
        )
        return [text]
    keys = ("projection", "fov_deg", "radius_px", "cx", "cy", "k1", "k2", "k3", "k4")
    given = [f"camera.{key}" for key in keys if getattr(camera, key) is not None]
    if not given:
        return []
    text = (
        f"{loaded.source} sets {', '.join(given)}, which override the file; set them to null to "
        "use the measured lens"
    )
    return [text]


def _some(pictures: list[Picture]) -> list[Picture]:
    """Enough of them to see the image circle, which needs no more than a few."""
    return pictures[:: max(1, len(pictures) // _CIRCLE_PICTURES)][:_CIRCLE_PICTURES]


def _chosen(asked: Asked) -> Model:
    projection = canonical_projection(asked.model or "equidistant")
    return Model(projection, 4 if asked.terms is None else asked.terms, asked.board_shape)


def _models(asked: Asked) -> list[Model]:
    chosen = _chosen(asked)
    return models_to_compare(chosen) if asked.compare else [chosen]
