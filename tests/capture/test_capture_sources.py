"""Choosing a source by its text; folders of pictures; network streams."""

from __future__ import annotations

import base64
import contextlib
import functools
import http.server
import threading

import cv2
import numpy as np
import pytest

from bikeped.capture import open_source
from bikeped.capture.cameras import NetworkSource
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


class _Camera(http.server.BaseHTTPRequestHandler):
    pictures: list[bytes] = []  # noqa: RUF012

    logins: list[str | None] | None = None

    def do_GET(self):
        if self.logins is not None:
            self.logins.append(self.headers.get("Authorization"))
            if self.logins[-1] is None:  # FFmpeg sends a login when it is asked
                self.send_response(401)
                self.send_header("WWW-Authenticate", 'Basic realm="camera"')
                self.end_headers()
                return
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
def serve():
    """Starts a network camera that sends these pictures; returns its port."""
    with contextlib.ExitStack() as stack:

        def start(pictures, logins=None):
            handler = type("Camera", (_Camera,), {"pictures": pictures, "logins": logins})
            server = http.server.HTTPServer(("127.0.0.1", 0), handler)
            thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
            thread.start()
            stack.callback(server.server_close)
            stack.callback(thread.join)
            stack.callback(server.shutdown)
            return server.server_port

        yield start


@pytest.fixture
def camera_port(make_jpeg, serve):
    return serve([make_jpeg(i) for i in range(8)])


def test_a_network_stream_is_live_and_its_end_is_an_error(camera_port, make_jpeg):
    times = iter(range(100, 200))
    source = NetworkSource(
        f"http://127.0.0.1:{camera_port}/video?key=secret", fps=10.0, clock=lambda: next(times)
    )
    with source:
        assert source.live
        assert source.name == f"http://127.0.0.1:{camera_port}/..."
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


@pytest.mark.parametrize("size", [(48, 32), (64, 64)], ids=["scaled", "other proportions"])
def test_frames_have_the_size_that_a_stream_changes_to(make_jpeg, serve, size):
    changed = make_jpeg(0, width=size[0], height=size[1])
    port = serve([make_jpeg(i) for i in range(4)] + [changed] * 4)
    with NetworkSource(f"http://127.0.0.1:{port}/video", fps=10.0) as source:
        frames = [source.read() for _ in range(8)]
    assert [(f.width, f.height) for f in frames] == [(WIDTH, HEIGHT)] * 4 + [size] * 4
    assert frames[-1].jpeg == changed


def test_a_damaged_picture_keeps_the_size_of_the_stream(make_jpeg, serve):
    port = serve([make_jpeg(0), make_jpeg(1), b"\xff\xd8 noise", make_jpeg(2)])
    with NetworkSource(f"http://127.0.0.1:{port}/video", fps=10.0) as source:
        sizes = {(f.width, f.height) for f in (source.read() for _ in range(3))}
    assert sizes == {(WIDTH, HEIGHT)}


def test_a_login_of_the_configuration_reaches_the_camera_and_nobody_else(
    serve, tmp_path, make_jpeg
):
    (tmp_path / "pw").write_text("s/e?c#r@t\n")
    port = serve([make_jpeg(i) for i in range(4)], logins := [])
    camera = CameraConfig(
        source=f"http://127.0.0.1:{port}/video", username="me", password_file="pw"
    )
    with open_source(camera, base_dir=tmp_path) as source:
        assert source.name == f"http://127.0.0.1:{port}/..."
    assert base64.b64decode(logins[-1].removeprefix("Basic ")) == b"me:s/e?c#r@t"
