"""The V4L2 camera, against a fake at cv2.VideoCapture."""

from __future__ import annotations

import logging
import math

import cv2
import numpy as np
import pytest

from bikeped.capture.cameras import MAX_REPEATING_S, V4l2Source, trim
from bikeped.capture.jpeg import read_size
from bikeped.errors import CaptureError

WIDTH, HEIGHT = 96, 64


class FakeCamera:
    """A driver: grants what `granted` says, plays `script`, and sets the clock by the arrival.

    A step is (buffer or None, stamp in s, arrival in s); the last one repeats for ever.
    """

    def __init__(self, script=(), *, opens=True, refuses=(), **granted):
        self.script, self.opens, self.refuses = list(script), opens, refuses
        self.granted = {getattr(cv2, name): value for name, value in granted.items()}
        self.props = {}
        self.order = []
        self.now_s = 0.0
        self.sleeps = 0
        self.released = 0
        self.stamp_s = 0.0

    def __call__(self, device, backend):
        self.device, self.backend = device, backend
        return self

    def isOpened(self):  # noqa: N802
        return self.opens

    def set(self, prop, value):
        self.order.append(prop)
        self.props[prop] = value
        return prop not in self.refuses

    def get(self, prop):
        if prop == cv2.CAP_PROP_POS_MSEC:
            return self.stamp_s * 1000.0
        return self.granted.get(prop, self.props.get(prop, 0.0))

    def read(self):
        data, self.stamp_s, arrival_s = self.script[0]
        if len(self.script) > 1:
            self.script.pop(0)
        self.now_s = max(self.now_s, arrival_s)
        if isinstance(data, Exception):
            raise data
        if data is None:
            return False, None
        return True, np.frombuffer(data, np.uint8)[None] if isinstance(data, bytes) else data

    def release(self):
        self.released += 1

    def sleep(self, seconds):
        self.sleeps += 1
        self.now_s += seconds


def _open(camera, device="/dev/video0", fourcc="MJPG", fps=30.0):
    return V4l2Source(
        device,
        width=WIDTH,
        height=HEIGHT,
        fps=fps,
        fourcc=fourcc,
        clock=lambda: camera.now_s,
        sleep=camera.sleep,
        open_capture=camera,
    )


@pytest.fixture
def jpegs(make_jpeg):
    return [make_jpeg(i) for i in range(3)]


def test_it_asks_for_format_size_rate_and_raw_buffers_in_this_order():
    camera = FakeCamera()
    source = _open(camera, device="2")
    assert (camera.device, camera.backend) == ("/dev/video2", cv2.CAP_V4L2)
    assert source.name == "/dev/video2"
    assert source.live
    assert camera.order == [
        cv2.CAP_PROP_FOURCC,
        cv2.CAP_PROP_FRAME_WIDTH,
        cv2.CAP_PROP_FRAME_HEIGHT,
        cv2.CAP_PROP_FPS,
        cv2.CAP_PROP_CONVERT_RGB,
    ]
    assert camera.props[cv2.CAP_PROP_FOURCC] == cv2.VideoWriter.fourcc(*"MJPG")
    assert camera.props[cv2.CAP_PROP_CONVERT_RGB] == 0
    assert (source.width, source.height, source.fps) == (WIDTH, HEIGHT, 30.0)


def test_frames_are_the_cameras_bytes_at_the_kernels_time(jpegs):
    camera = FakeCamera([(jpegs[0], 100.0, 100.04), (jpegs[1], 100.0333, 100.08)])
    source = _open(camera)
    first, second = source.read(), source.read()
    assert [first.jpeg, second.jpeg] == jpegs[:2]
    assert [first.captured_s, second.captured_s] == pytest.approx([100.0, 100.0333])
    assert [first.number, second.number] == [0, 1]
    assert (first.width, first.height) == (WIDTH, HEIGHT)


@pytest.mark.parametrize(
    "stamp_s",
    [0.0, 97.9, 100.05, 1.7e9, math.nan],
    ids=["none", "old", "future", "wall clock", "nan"],
)
def test_a_stamp_that_cannot_be_of_the_monotonic_clock_gives_way_to_the_arrival(jpegs, stamp_s):
    camera = FakeCamera([(jpegs[0], stamp_s, 100.04)])
    assert _open(camera).read().captured_s == 100.04


def test_a_stamp_that_stands_still_under_new_pictures_gives_way_to_the_arrival(jpegs):
    camera = FakeCamera([(jpegs[0], 100.0, 100.01), (jpegs[1], 100.0, 100.04)])
    source = _open(camera)
    assert [source.read().captured_s, source.read().captured_s] == [100.0, 100.04]


def test_a_repeated_buffer_is_no_frame(jpegs):
    camera = FakeCamera(
        [(jpegs[0], 100.0, 100.0)] + [(jpegs[0], 100.0, 100.01)] * 3 + [(jpegs[1], 100.1, 100.1)]
    )
    source = _open(camera)
    assert source.read().jpeg == jpegs[0]
    second = source.read()
    assert (second.jpeg, second.number) == (jpegs[1], 1)
    assert camera.sleeps == 3


def test_a_static_scene_with_new_stamps_is_not_a_repeated_buffer(jpegs):
    camera = FakeCamera([(jpegs[0], 100.0, 100.0), (jpegs[0], 100.1, 100.1)])
    source = _open(camera)
    assert [source.read().captured_s, source.read().captured_s] == pytest.approx([100.0, 100.1])


def test_a_buffer_that_repeats_for_long_is_an_unplugged_camera(jpegs):
    camera = FakeCamera([(jpegs[0], 100.0, 100.0)])
    source = _open(camera)
    source.read()
    with pytest.raises(CaptureError, match="/dev/video0: repeats"):
        source.read()
    assert MAX_REPEATING_S < camera.now_s - 100.0 < MAX_REPEATING_S + 0.1


@pytest.mark.parametrize("answer", [None, b"", cv2.error("select failed")])
def test_no_picture_is_an_error(answer):
    source = _open(FakeCamera([(answer, 0.0, 100.0)]))
    with pytest.raises(CaptureError, match="/dev/video0"):
        source.read()


@pytest.mark.parametrize("padding", [b"", b"\0", b"\0" * 5000, b"\xd9\xd9\xff\xff" + b"\0" * 7])
def test_padding_behind_the_picture_is_cut_off(jpegs, padding):
    camera = FakeCamera([(jpegs[0] + padding, 100.0, 100.0)])
    assert _open(camera).read().jpeg == jpegs[0]


def test_bytes_without_an_end_marker_stay_for_the_decoder_to_refuse():
    assert trim(b"\xff\xd8 cut off\0\0") == b"\xff\xd8 cut off\0\0"


def test_a_damaged_first_picture_does_not_end_the_camera(jpegs):
    camera = FakeCamera([(b"\xff\xd8 noise", 100.0, 100.0), (jpegs[0], 100.1, 100.1)])
    source = _open(camera)
    assert source.read().jpeg == b"\xff\xd8 noise"
    assert read_size(source.read().jpeg) == (WIDTH, HEIGHT)


def test_other_formats_come_as_rgb(make_picture):
    camera = FakeCamera([(make_picture(0), 100.0, 100.0), (make_picture(1), 100.1, 100.1)])
    source = _open(camera, fourcc="YUYV")
    assert cv2.CAP_PROP_CONVERT_RGB not in camera.props
    frame = source.read()
    assert frame.jpeg is None
    assert np.array_equal(frame.rgb, make_picture(0)[:, :, ::-1])
    assert np.array_equal(source.read().rgb, make_picture(1)[:, :, ::-1])


def test_a_repeated_rgb_buffer_is_no_frame_either(make_picture):
    camera = FakeCamera([(make_picture(0), 100.0, 100.0)])
    source = _open(camera, fourcc="YUYV")
    source.read()
    with pytest.raises(CaptureError, match="repeats"):
        source.read()


def test_another_size_than_asked_is_refused_by_name_and_the_camera_released():
    camera = FakeCamera(CAP_PROP_FRAME_WIDTH=80, CAP_PROP_FRAME_HEIGHT=60)
    with pytest.raises(CaptureError, match=r"/dev/video0: grants 80x60, not 96x64.*camera\.width"):
        _open(camera)
    assert camera.released == 1


def test_another_format_than_asked_is_refused_by_name():
    camera = FakeCamera(CAP_PROP_FOURCC=cv2.VideoWriter.fourcc(*"YUYV"))
    with pytest.raises(CaptureError, match=r"format YUYV, not MJPG.*camera\.fourcc"):
        _open(camera)
    assert camera.released == 1


def test_jpeg_and_mjpg_are_the_same_to_us(jpegs):
    camera = FakeCamera([(jpegs[0], 100.0, 100.0)], CAP_PROP_FOURCC=cv2.VideoWriter.fourcc(*"JPEG"))
    assert _open(camera).read().jpeg == jpegs[0]


def test_pictures_of_another_size_than_granted_are_refused(make_jpeg):
    source = _open(FakeCamera([(make_jpeg(0, width=48), 100.0, 100.0)]))
    with pytest.raises(CaptureError, match="grants 96x64 but sends 48x64"):
        source.read()


def test_an_opencv_that_keeps_the_raw_bytes_is_refused():
    with pytest.raises(CaptureError, match="update opencv"):
        _open(FakeCamera(refuses=[cv2.CAP_PROP_CONVERT_RGB]))


@pytest.mark.parametrize(("granted", "fps", "said"), [(15.0, 15.0, True), (0.0, 30.0, False)])
def test_another_rate_is_taken_as_granted_and_said(caplog, granted, fps, said):
    with caplog.at_level(logging.WARNING):
        assert _open(FakeCamera(CAP_PROP_FPS=granted)).fps == fps
    assert ("grants 15 frames per second" in caplog.text) == said


def test_a_busy_device_a_missing_one_and_a_wrong_fourcc_are_told_apart(tmp_path):
    device = tmp_path / "video9"
    with pytest.raises(CaptureError, match="no such camera; plug it in"):
        _open(FakeCamera(opens=False), device=str(device))
    device.touch()
    with pytest.raises(CaptureError, match="another program"):
        _open(FakeCamera(opens=False), device=str(device))
    with pytest.raises(CaptureError, match=r"camera\.fourcc"):
        _open(FakeCamera(), fourcc="MJPEG")
