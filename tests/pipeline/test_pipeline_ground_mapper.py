"""Ground mapping: which detections stand on the ground and in range."""

import numpy as np
import pytest

from bikeped.config.load import load_config
from bikeped.errors import GeometryError
from bikeped.pipeline.track_and_decide import GroundMapper
from bikeped.types import Detections, Kind


def standing_at(*bottom_px: tuple[float, float]) -> Detections:
    """Pedestrians 40 wide and 100 high whose boxes end at these pixels of a 3840 x 2160 frame."""
    box = np.array([[u - 20, v - 100, u + 20, v] for u, v in bottom_px], np.float32)
    return Detections(
        np.full(len(box), Kind.PEDESTRIAN, np.int8), np.full(len(box), 0.9, np.float32), box
    )


def test_points_name_the_detections_that_stand_on_the_ground_in_range():
    mapper = GroundMapper(load_config(None, ["tracking.max_range_m=8"]))
    frame = mapper.framing_for(3840, 2160)
    near, sky, far = (1920.0, 1700.0), (1920.0, 300.0), (1920.0, 1250.0)
    points, not_on_ground = mapper.to_ground(standing_at(sky, far, near), frame)
    assert points.detection.tolist() == [2]
    exact, valid = mapper.camera.ground(frame.frame_to_crop(np.array([near])))
    assert valid.all()
    assert points.xy_m == pytest.approx(exact, abs=0.02)
    assert not_on_ground == 1, "who stands too far away is on the ground all the same"


def test_a_smaller_frame_of_the_same_camera_is_the_same_ground():
    mapper = GroundMapper(load_config(None))
    large, _ = mapper.to_ground(standing_at((1500.0, 1700.0)), mapper.framing_for(3840, 2160))
    half = standing_at((1500.0, 1700.0))
    half = Detections(half.kind, half.confidence, half.box_px / 2)
    small, _ = mapper.to_ground(half, mapper.framing_for(1920, 1080))
    assert small.xy_m == pytest.approx(large.xy_m, abs=1e-3)


def test_frames_of_another_shape_are_another_cameras():
    mapper = GroundMapper(load_config(None))
    with pytest.raises(GeometryError):
        mapper.framing_for(1000, 1000)
