"""Recordings, on real files that are written here."""

from __future__ import annotations

import itertools
import logging

import cv2
import numpy as np
import pytest
from shared_inputs import CLIP, missing

from bikeped.capture import open_source
from bikeped.capture.jpeg import JpegDecoder
from bikeped.capture.recordings import VideoSource
from bikeped.config.schema import CameraConfig
from bikeped.errors import CaptureError

WIDTH, HEIGHT, FPS = 96, 64, 25.0


def _all(source):
    return list(iter(source.read, None))


class Scripted:
    """A cv2.VideoCapture whose answers are given: `pictures` and their time stamps."""

    def __init__(self, pictures, stamps_ms, raw_pictures=None, tag="MJPG", **answers):
        self.pictures, self.stamps_ms, self.raw_pictures = pictures, stamps_ms, raw_pictures
        self.answers = {
            cv2.CAP_PROP_FRAME_WIDTH: WIDTH,
            cv2.CAP_PROP_FRAME_HEIGHT: HEIGHT,
            cv2.CAP_PROP_FPS: FPS,
            cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*tag),
            **{getattr(cv2, name): value for name, value in answers.items()},
        }
        self.opened = 0
        self.released = 0

    def __call__(self, *_):
        self.opened += 1
        self.at, self.raw = 0, False
        return self

    def isOpened(self):  # noqa: N802
        return True

    def get(self, prop):
        if prop == cv2.CAP_PROP_POS_MSEC:
            return self.stamps_ms[self.at - 1]
        return self.answers.get(prop, 0.0)

    def set(self, prop, value):
        self.raw = (prop, value) == (cv2.CAP_PROP_FORMAT, -1)
        return self.raw

    def read(self):
        pictures = self.raw_pictures if self.raw else self.pictures
        if self.at >= len(pictures):
            return False, None
        self.at += 1
        return True, pictures[self.at - 1]

    def release(self):
        self.released += 1


def _scripted(tmp_path, capture):
    path = tmp_path / "any.avi"
    path.write_bytes(b"x")
    return VideoSource(path, open_capture=capture)


@pytest.mark.parametrize("name", ["a.avi", "a.mkv", "a.mov"])
def test_motion_jpeg_is_handed_on_undecoded(write_video, make_picture, name):
    with VideoSource(write_video(name, "MJPG")) as source:
        assert (source.width, source.height, source.fps) == (WIDTH, HEIGHT, FPS)
        assert source._raw
        assert not source.live
        frames = _all(source)
    assert [frame.number for frame in frames] == list(range(6))
    assert [frame.captured_s for frame in frames] == pytest.approx([i / FPS for i in range(6)])
    decoder = JpegDecoder()
    for i, frame in enumerate(frames):
        assert frame.rgb is None
        image = decoder.decode(frame.jpeg)
        assert np.abs(image.astype(int) - make_picture(i)[:, :, ::-1]).mean() < 12


def test_other_codecs_are_decoded_to_rgb(write_video, make_picture):
    with VideoSource(write_video("a.mp4", "mp4v")) as source:
        assert not source._raw
        frames = _all(source)
    assert len(frames) == 6
    for i, frame in enumerate(frames):
        assert frame.jpeg is None
        assert frame.rgb.shape == (HEIGHT, WIDTH, 3)
        assert np.abs(frame.rgb.astype(int) - make_picture(i)[:, :, ::-1]).mean() < 16


@pytest.mark.parametrize(("name", "fourcc"), [("a.avi", "MJPG"), ("a.mp4", "mp4v")])
def test_two_runs_are_the_same(write_video, name, fourcc):
    path = write_video(name, fourcc)
    runs = []
    for _ in range(2):
        with VideoSource(path) as source:
            runs.append(
                [(frame.captured_s, frame.jpeg or frame.rgb.tobytes()) for frame in _all(source)]
            )
    assert runs[0] == runs[1]
    assert len(runs[0]) == 6


def test_h264_of_the_shared_recording():
    if why := missing(CLIP):
        pytest.skip(why)
    with VideoSource(CLIP) as source:
        assert (source.width, source.height, source.fps) == (768, 432, 12.0)
        frames = list(itertools.islice(iter(source.read, None), 5))
    assert [frame.captured_s for frame in frames] == pytest.approx([i / 12 for i in range(5)])
    assert all(frame.rgb.shape == (432, 768, 3) for frame in frames)


def test_a_recording_without_huffman_tables_is_handed_on_and_decodes(
    tmp_path, make_jpeg, without_tables
):
    bare = without_tables(make_jpeg(3))
    packet = np.frombuffer(bare, np.uint8)[None]
    source = _scripted(tmp_path, Scripted([], [0.0, 40.0], raw_pictures=[packet, packet]))
    frame = source.read()
    assert frame.jpeg == bare
    assert np.array_equal(JpegDecoder().decode(frame.jpeg), JpegDecoder().decode(make_jpeg(3)))


def _row(data: bytes):
    return np.frombuffer(data, np.uint8)[None]


@pytest.mark.parametrize("why", ["no JPEG", "half the height: interlaced"])
def test_packets_that_are_no_whole_jpeg_are_decoded_by_opencv(
    tmp_path, make_picture, make_jpeg, why
):
    packet = b"\x00\x00\x01\xb6 not a JPEG" if why == "no JPEG" else make_jpeg(0, height=32)
    capture = Scripted([make_picture(0)], [0.0], raw_pictures=[_row(packet)])
    source = _scripted(tmp_path, capture)
    assert not source._raw
    assert capture.opened == 2
    assert np.array_equal(source.read().rgb, make_picture(0)[:, :, ::-1])
    assert source.read() is None


def test_a_turned_recording_is_decoded_by_opencv_which_turns_it_back(
    tmp_path, make_picture, make_jpeg
):
    capture = Scripted(
        [make_picture(0, width=HEIGHT, height=WIDTH)],
        [0.0],
        raw_pictures=[_row(make_jpeg(0))],
        CAP_PROP_ORIENTATION_META=90.0,
    )
    source = _scripted(tmp_path, capture)
    assert not source._raw
    assert (source.width, source.height) == (HEIGHT, WIDTH)


@pytest.mark.parametrize(
    ("stamps_ms", "expected_s"),
    [
        ([0.0, 40.0, 120.0, 160.0], [0.0, 0.04, 0.12, 0.16]),  # a gap is kept
        ([0.0, 0.0, 0.0, 0.0], [0.0, 0.04, 0.08, 0.12]),  # no stamps
        ([0.0, 40.0, 40.0, 30.0], [0.0, 0.04, 0.08, 0.12]),  # not increasing
        ([float("nan")] * 4, [0.0, 0.04, 0.08, 0.12]),
    ],
)
def test_media_time_strictly_increases(tmp_path, make_picture, stamps_ms, expected_s):
    source = _scripted(
        tmp_path, Scripted([make_picture(i) for i in range(4)], stamps_ms, tag="avc1")
    )
    assert [frame.captured_s for frame in _all(source)] == pytest.approx(expected_s)


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), 1e9])
def test_a_video_without_a_rate_is_refused_and_closed(tmp_path, make_picture, fps):
    capture = Scripted([make_picture(0)], [0.0], tag="avc1", CAP_PROP_FPS=fps)
    with pytest.raises(CaptureError, match=r"any\.avi: has no frame rate"):
        _scripted(tmp_path, capture)
    assert capture.released == 1


def test_opencv_errors_become_capture_errors(tmp_path, make_picture):
    capture = Scripted([make_picture(0)], [0.0], tag="avc1")
    source = _scripted(tmp_path, capture)
    source.read()

    def fail():
        raise cv2.error("decoder gave up")

    capture.read = fail
    with pytest.raises(CaptureError, match=r"any\.avi: cannot be read"):
        source.read()


@pytest.mark.parametrize("content", [b"", b"hello" * 1000, b"RIFF\xff\xff\xff\xffAVI LIST"])
def test_files_that_are_no_video_are_refused_in_one_quiet_line(tmp_path, capfd, content):
    path = tmp_path / "junk.avi"
    path.write_bytes(content)
    with pytest.raises(CaptureError) as caught:
        VideoSource(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_a_header_without_pictures_is_refused(write_video):
    path = write_video("a.avi", "MJPG")
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"movi") + 4])
    with pytest.raises(CaptureError, match="no image that can be read"):
        VideoSource(path)


def test_a_cut_recording_ends_and_says_so(write_video, caplog):
    path = write_video("a.avi", "MJPG", frames=40)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with caplog.at_level(logging.WARNING), VideoSource(path) as source:
        frames = _all(source)
    assert 2 <= len(frames) < 30
    assert "of 40 frames" in caplog.text
    with pytest.raises(CaptureError):  # the packet that was cut through
        JpegDecoder().decode(frames[-1].jpeg)


def test_a_whole_recording_ends_without_a_word(write_video, caplog):
    with caplog.at_level(logging.WARNING), VideoSource(write_video("a.avi", "MJPG")) as source:
        assert len(_all(source)) == 6
        assert source.read() is None
    assert caplog.text == ""


def test_open_source_takes_a_video_by_its_path(write_video):
    path = write_video("a.avi", "MJPG")
    with open_source(CameraConfig(), str(path)) as source:
        assert isinstance(source, VideoSource)
        assert (source.width, source.fps) == (WIDTH, FPS)  # its own, not those asked of a camera
