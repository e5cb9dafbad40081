"""Draws the bundled model's check picture: bikeped/models/check.jpg, and its boxes in check.json.

It is a piece of a drawn street with a pedestrian and a cyclist that the model, in floating point
and in 8 bits, finds with much confidence. Run it anew when the bundled model changes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bikeped.config.load import load_config
from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import load_detector
from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.models import BUNDLED_FILE, BUNDLED_INT8_FILE, CHECK_PICTURE_FILE
from bikeped.pipeline.check_picture import known_answers, write_check_picture
from bikeped.types import Detections, ImageArray, Kind

SIZE = 1152, 648  #: of the street, at the model's own width
PIECE = 288, 240
PEOPLE = {int(Kind.PEDESTRIAN), int(Kind.CYCLIST)}


def main() -> None:
    detectors = [
        load_detector(DetectionConfig(model=str(file)), BUNDLED_FILE.parent)
        for file in (BUNDLED_FILE, BUNDLED_INT8_FILE)
    ]
    camera = scene_camera(load_config(None), SIZE)
    best: tuple[float, ImageArray, Detections] | None = None
    for seed, scenario in enumerate(load_scenarios(bundled_folder())):
        painter = ScenePainter(scenario, camera, Conditions(seed=seed))
        for t_s in np.arange(1.0, scenario.duration_s, 0.5).tolist():
            image, _ = painter.draw(t_s)
            for u, v in corners(detectors[0].infer(image, *SIZE).detections):
                piece = np.full((SIZE[1], SIZE[0], 3), 114, np.uint8)
                cut = image[v : v + PIECE[1], u : u + PIECE[0]]
                top, left = (SIZE[1] - PIECE[1]) // 2, (SIZE[0] - PIECE[0]) // 2
                piece[top : top + PIECE[1], left : left + PIECE[0]] = cut
                found = [known_answers(d.infer(piece, *SIZE).detections, 0.1) for d in detectors]
                if any(set(each.kind.tolist()) != PEOPLE or len(each) != 2 for each in found):
                    continue
                least = min(float(each.confidence.min()) for each in found)
                if best is None or least > best[0]:
                    box = found[1].box_px - np.array([left, top] * 2, np.float32)
                    best = least, cut, replace(found[1], box_px=box)
    assert best is not None, "no drawn street holds both"
    write_check_picture(CHECK_PICTURE_FILE, best[1], best[2], None)
    print(f"wrote {CHECK_PICTURE_FILE}: least confidence {best[0]:.2f}")


def corners(found: Detections) -> list[tuple[int, int]]:
    """Left upper corners of pieces around each pedestrian with a cyclist near."""
    middles = (found.box_px[:, :2] + found.box_px[:, 2:]) / 2
    found_corners = []
    for one in np.nonzero(found.kind == Kind.PEDESTRIAN)[0]:
        for other in np.nonzero(found.kind == Kind.CYCLIST)[0]:
            if (np.abs(middles[one] - middles[other]) < np.array(PIECE) / 2).all():
                corner = (middles[one] + middles[other]) / 2 - np.array(PIECE) / 2
                u, v = np.clip(corner, 0, np.array(SIZE) - PIECE).round().astype(int).tolist()
                found_corners.append((u, v))
    return found_corners


if __name__ == "__main__":
    main()
