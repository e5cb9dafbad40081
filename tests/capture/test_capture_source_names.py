"""What a camera is called: without a password, and the same under another number."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bikeped.capture.cameras import V4l2Source
from bikeped.capture.source_names import DeviceNames, address_with_login, shown_source
from bikeped.config.schema import CameraConfig
from bikeped.errors import CaptureError


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("rtsp://user:secret@10.0.0.2:554/ch1", "rtsp://10.0.0.2:554/..."),
        ("http://10.0.0.2/video?password=secret", "http://10.0.0.2/..."),
        ("http://10.0.0.2", "http://10.0.0.2"),
        ("rtsp://user:sec@ret@cam/1", "rtsp://cam/..."),
        ("rtsp://user:se/cret@cam/1", "rtsp://..."),
        ("rtsp://user:se?cret@cam/1", "rtsp://..."),
        ("rtsp://user:se#cret@cam/1", "rtsp://..."),
        ("rtsp://cam/user=me&password=sec@ret", "rtsp://..."),
        ("rtsp://user:secret", "rtsp://..."),
        ("RTSP:/user:secret@cam/1", "RTSP://cam/..."),
        ("http://[fe80::1]:80/x", "http://[fe80::1]:80/..."),
        ("http://[secret", "http://..."),
        ("/dev/video0", "/dev/video0"),
        ("0", "0"),
        ("folder/day.mp4", "folder/day.mp4"),
    ],
)
def test_of_an_address_only_scheme_and_host_are_shown(source, shown):
    assert shown_source(source) == shown


@given(st.text("ab1/?#@:%&=. ", max_size=12), st.text("ab1/?#@:%&=. ", max_size=12), st.booleans())
def test_no_part_of_a_password_is_shown_wherever_it_stands(before, after, in_path):
    password = f"{before}Geheim{after}"
    login = "" if in_path else f"me:{password}@"
    path = f"user=me&password={password}" if in_path else "ch1"
    shown = shown_source(f"rtsp://{login}cam.lan:554/{path}")
    assert "Geheim" not in shown
    assert re.fullmatch(r"rtsp://(\.\.\.|cam\.lan:554/\.\.\.)", shown)


def _camera(**keys):
    return CameraConfig(source="rtsp://old:one@cam/ch1", **keys)


def test_a_login_of_the_configuration_is_quoted_and_replaces_the_addresss(tmp_path):
    (tmp_path / "pw").write_text("a/b?c#d@e\r\nnext line")
    camera = _camera(username="m/e", password_file="pw")
    address = address_with_login(camera, camera.source, tmp_path)
    assert address == "rtsp://m%2Fe:a%2Fb%3Fc%23d%40e@cam/ch1"
    only_name = _camera(username="me")
    assert address_with_login(only_name, only_name.source, tmp_path) == "rtsp://me@cam/ch1"
    assert address_with_login(_camera(), "rtsp://cam", tmp_path) == "rtsp://cam"


@pytest.mark.parametrize(
    ("content", "said"), [(None, "No such file"), (b"\n", "empty"), (b"\xff\xfe", "UTF-8")]
)
def test_a_password_file_that_cannot_be_used_is_named(tmp_path, content, said):
    if content is not None:
        (tmp_path / "pw").write_bytes(content)
    with pytest.raises(CaptureError, match=rf"pw: camera\.password_file.*{said}"):
        address_with_login(_camera(username="me", password_file="pw"), "rtsp://cam", tmp_path)


class FakeDev:
    """A /dev with udev's links; `cameras` maps video numbers to serial numbers and ports."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for folder in ("by-id", "by-path"):
            (root / "v4l" / folder).mkdir(parents=True)

    def plug(self, number: int, serial: str, port: str) -> str:
        node = self.root / f"video{number}"
        node.touch()
        for folder, name in (("by-id", f"usb-{serial}-index0"), ("by-path", f"pci-{port}-index0")):
            (self.root / "v4l" / folder / name).symlink_to(f"../../video{number}")
        return str(node)

    def unplug(self, number: int) -> None:
        for link in self.root.glob("v4l/*/*"):
            if link.resolve().name == f"video{number}":
                link.unlink()
        (self.root / f"video{number}").unlink()


class Granting:
    """An OpenCV capture that grants all; opens only nodes that are there."""

    def __init__(self) -> None:
        self.opened: list[str] = []
        self.props: dict[int, float] = {}

    def __call__(self, path: str, _backend: int) -> Granting:
        self.opened.append(path)
        return self

    def isOpened(self) -> bool:  # noqa: N802
        return Path(self.opened[-1]).exists()

    def set(self, prop: int, value: float) -> bool:
        self.props[prop] = value
        return True

    def get(self, prop: int) -> float:
        return self.props.get(prop, 0.0)

    def release(self) -> None:
        pass


@pytest.fixture
def dev(tmp_path):
    return FakeDev(tmp_path)


@pytest.fixture
def capture(dev):
    names, camera = DeviceNames(dev.root), Granting()

    def open_(device):
        V4l2Source(device, width=96, height=64, fps=30, open_capture=camera, names=names)
        return camera.opened[-1]

    return open_


def test_a_camera_that_comes_back_under_another_number_is_found(dev, capture):
    first = dev.plug(0, "A1", "port1")
    assert capture(first) == first
    dev.unplug(0)
    moved = dev.plug(2, "A1", "port7")
    assert capture(first) == moved


def test_another_camera_under_the_old_number_is_not_taken_for_it(dev, capture):
    first = dev.plug(0, "A1", "port1")
    capture(first)
    dev.unplug(0)
    dev.plug(0, "B2", "port2")
    with pytest.raises(CaptureError, match="no such camera"):
        capture(first)
    assert capture(dev.plug(4, "B3", "port1")).endswith("video4")  # where the first one was
    back = dev.plug(5, "A1", "port3")
    assert capture(first) == back


def test_a_camera_without_links_is_its_number(dev, capture):
    node = dev.root / "video0"
    node.touch()
    assert capture(str(node)) == str(node)
    node.unlink()
    with pytest.raises(CaptureError, match="video0: no such camera"):
        capture(str(node))


def test_a_lasting_name_is_opened_as_it_is(dev, capture):
    dev.plug(0, "A1", "port1")
    link = str(dev.root / "v4l/by-id/usb-A1-index0")
    assert capture(link) == link
    dev.unplug(0)
    dev.plug(3, "A1", "port1")
    assert capture(link).endswith("video3")
