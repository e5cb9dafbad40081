"""Choosing a source by its text; folders of pictures; network streams."""

from __future__ import annotations

import functools
import http.server
import threading

import cv2
import numpy as np
import pytest

from bikeped.capture import open_source
from bikeped.capture.cameras import NetworkSource, without_password
from bikeped.capture.jpeg import JpegDecoder
from bikeped.capture.recordings import ImageSource
from bikeped.config.schema import CameraConfig
from bikeped.errors import CaptureError

WIDTH, HEIGHT = 96, 64
choose = functools.partial(open_source, CameraConfig(width=WIDTH, height=HEIGHT, fps=10.0))


@pytest.fixture
def folder(tmp_path, make_picture, make_jpeg):
    for name, index in [("frame10.jpg", 2), ("frame2.JPG", 1), ("frame1.jpg", 0)]:
        (tmp_path / name).write_bytes(make_jpeg(index))
    cv2.imwrite(str(tmp_path / "frame11.png"), make_picture(3))
    (tmp_path / "notes.txt").write_text("not a picture")
    return tmp_path


def test_a_folder_is_shown_in_natural_order(folder, make_picture, make_jpeg):
    with choose(str(folder)) as source:
        assert isinstance(source, ImageSource)
        assert (source.width, source.height, source.fps, source.live) == (
            WIDTH,
            HEIGHT,
            10.0,
            False,
        )
        frames = list(iter(source.read, None))
        assert source.read() is None
    assert [frame.jpeg for frame in frames] == [make_jpeg(0), make_jpeg(1), make_jpeg(2), None]
    assert np.array_equal(frames[3].rgb, make_picture(3)[:, :, ::-1])
    assert [frame.number for frame in frames] == [0, 1, 2, 3]
    assert [frame.captured_s for frame in frames] == pytest.approx([0.0, 0.1, 0.2, 0.3])


def test_one_picture_is_a_recording_of_one(folder):
    with choose(str(folder / "frame11.png")) as source:
        assert len(list(iter(source.read, None))) == 1


def test_a_damaged_jpeg_is_left_to_the_decoder(folder):
    (folder / "frame2.JPG").write_bytes(b"\xff\xd8 broken")
    source = ImageSource(folder, fps=10.0)
    frames = list(iter(source.read, None))
    assert (frames[1].width, frames[1].height) == (WIDTH, HEIGHT)
    with pytest.raises(CaptureError):
        JpegDecoder().decode(frames[1].jpeg)


def test_a_damaged_first_jpeg_has_no_size_to_go_by(folder):
    (folder / "frame0.jpg").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"frame0\.jpg"):
        ImageSource(folder, fps=10.0)


@pytest.mark.parametrize("content", [b"", b"no png"])
def test_a_damaged_png_is_named(folder, content):
    (folder / "frame12.png").write_bytes(content)
    source = ImageSource(folder, fps=10.0)
    with pytest.raises(CaptureError, match=r"frame12\.png: is not an image"):
        list(iter(source.read, None))


def test_pictures_of_two_sizes_are_refused(folder, make_jpeg):
    (folder / "frame3.jpg").write_bytes(make_jpeg(0, width=48))
    source = ImageSource(folder, fps=10.0)
    with pytest.raises(CaptureError, match=r"frame3\.jpg: is 48x64 pixels.* 96x64"):
        list(iter(source.read, None))


def test_an_empty_folder_and_a_zero_rate_are_refused(tmp_path, folder):
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(CaptureError, match="holds no images"):
        ImageSource(empty, fps=10.0)
    with pytest.raises(CaptureError, match=r"camera\.fps"):
        ImageSource(folder, fps=0.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("nowhere.mp4", ["nowhere.mp4", "no such file", "camera.source"]),
        ("udp://239.0.0.1:5000", ["udp://", "rtsp://"]),
        ("/dev/no-such-camera", ["/dev/no-such-camera", "no such camera"]),
        ("4711", ["/dev/video4711", "no such camera"]),
        ("/dev/null", ["/dev/null", "cannot be opened"]),
    ],
)
def test_what_cannot_be_opened_is_named_in_one_line(text, words, capfd):
    with pytest.raises(CaptureError) as caught:
        choose(text)
    message = str(caught.value)
    assert all(word in message for word in words)
    assert "\n" not in message
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("rtsp://user:secret@10.0.0.2:554/ch1", "rtsp://10.0.0.2:554/ch1"),
        ("http://10.0.0.2/video?password=secret", "http://10.0.0.2/video"),
        ("rtsp://user:sec@ret@cam/1", "rtsp://cam/1"),
        ("http://[secret", "http://..."),
    ],
)
def test_passwords_are_not_shown(address, shown):
    assert without_password(address) == shown


class _Camera(http.server.BaseHTTPRequestHandler):
    pictures: list[bytes] = []  # noqa: RUF012

    def do_GET(self):
        if self.path.split("?")[0] != "/video":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
        self.end_headers()
        for data in self.pictures:
            self.wfile.write(
                b"--next\r\nContent-Type: image/jpeg\r\nContent-Length: "
                + str(len(data)).encode()
                + b"\r\n\r\n"
                + data
                + b"\r\n"
            )

    def log_message(self, *_):
        pass


@pytest.fixture
def camera_port(make_jpeg):
    handler = type("Camera", (_Camera,), {"pictures": [make_jpeg(i) for i in range(8)]})
    server = http.server.HTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server.server_port
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_network_stream_is_live_and_its_end_is_an_error(camera_port, make_jpeg):
    times = iter(range(100, 200))
    source = NetworkSource(
        f"http://127.0.0.1:{camera_port}/video?key=secret", fps=10.0, clock=lambda: next(times)
    )
    with source:
        assert source.live
        assert source.name == f"http://127.0.0.1:{camera_port}/video"
        assert (source.width, source.height) == (WIDTH, HEIGHT)
        frames = [source.read() for _ in range(4)]
        with pytest.raises(CaptureError, match="the stream ended") as caught:
            list(iter(source.read, None))
    assert "secret" not in str(caught.value)
    assert [frame.captured_s for frame in frames] == [100, 101, 102, 103]
    assert [frame.number for frame in frames] == [0, 1, 2, 3]
    assert [frame.jpeg for frame in frames] == [make_jpeg(i) for i in range(4)]


def test_a_network_camera_that_is_not_there_is_an_error_without_its_password(camera_port, capfd):
    with pytest.raises(CaptureError, match="cannot be opened") as caught:
        choose(f"http://me:secret@127.0.0.1:{camera_port}/other")
    assert "secret" not in str(caught.value)
    assert capfd.readouterr().err == ""
