"""Images to calibrate from: files, folders and videos, all of one size, decoded on demand.

An image is kept encoded: forty decoded 12-megapixel images would take half a gigabyte.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bikeped.capture.jpeg import read_size
from bikeped.capture.opencv import silence_opencv
from bikeped.capture.recordings import IMAGE_SUFFIXES, JPEG_SUFFIXES, VideoSource, image_paths
from bikeped.errors import CalibrationError, CaptureError
from bikeped.types import Frame, ImageArray

#: A video is cut into pieces of this length; the sharpest frame of each is used.
VIDEO_PIECE_S = 0.5
#: At most so many pieces of one video: longer videos have longer pieces.
VIDEO_PIECES = 150
LEAST_SIDE_PX = 32  #: a board of the smallest squares that are detected needs more
_SHARPNESS_WIDTH = 640  # sharpness is measured on an image of about this width


@dataclass(frozen=True)
class CalibrationImage:
    """One image, encoded or grey. `moving`: a video's frame, similar to its neighbours."""

    name: str  #: the file's path, or `clip.mp4 frame 120`
    width: int
    height: int
    digest: str  #: SHA-256 of the file's (or the frame's) bytes
    content: bytes | ImageArray
    moving: bool = False

    def grey(self) -> ImageArray:
        """[height, width] grey levels, not turned by EXIF; CalibrationError for a broken file."""
        if isinstance(self.content, np.ndarray):
            return self.content
        return decode_grey(self.content, self.name)


def load_images(paths: Iterable[Path | str]) -> list[CalibrationImage]:
    """The images of files, folders and videos, of one size, in the order given.

    CalibrationError, naming file and remedy: missing, unreadable, of another size than the first,
    or none at all.
    """
    images = [image for entry in paths for image in _load(Path(entry))]
    if not images:
        raise CalibrationError(
            "no picture to calibrate from; name files, a folder of pictures or a video"
        )
    check_image_sizes(images)
    return images


def check_image_sizes(images: Sequence[CalibrationImage]) -> None:
    """CalibrationError where an image is too small for a board, or not of the first one's size."""
    first = images[0]
    for image in images:
        if min(image.width, image.height) < LEAST_SIDE_PX:
            raise CalibrationError(
                f"{image.name}: is {image.width}x{image.height} pixels, too small for a "
                "board; take the camera's own pictures, not thumbnails"
            )
        if (image.width, image.height) != (first.width, first.height):
            raise CalibrationError(
                f"{image.name}: is {image.width}x{image.height} pixels, but {first.name} is "
                f"{first.width}x{first.height}; calibrate pictures of one size at a time"
            )


def images_hash(images: Sequence[CalibrationImage]) -> str:
    """SHA-256 over the images' bytes in order of name, duplicates included."""
    digest = hashlib.sha256()
    for image in sorted(images, key=lambda one: one.name):
        digest.update(bytes.fromhex(image.digest))
    return digest.hexdigest()


def decode_grey(content: bytes, name: str) -> ImageArray:
    """[h, w] grey levels of an encoded image; CalibrationError when it cannot be decoded."""
    try:
        with silence_opencv():
            data = np.frombuffer(content, np.uint8)
            flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
            image = cv2.imdecode(data, flags) if len(data) else None
    except cv2.error as error:
        raise CalibrationError(f"{name}: is no picture ({error.err}); remove it") from error
    if image is None:
        raise CalibrationError(f"{name}: is no picture that can be decoded; remove it")
    return np.asarray(image, np.uint8)


def _load(path: Path) -> list[CalibrationImage]:
    if not path.exists():
        raise CalibrationError(f"{path}: no such file or folder")
    try:
        files = image_paths(path)
        if path.is_dir() and not files:
            raise CalibrationError(
                f"{path}: holds no pictures ({', '.join(sorted(IMAGE_SUFFIXES))})"
            )
        if path.is_file() and path.suffix.lower() not in IMAGE_SUFFIXES:
            return _video(path)
        return [_image(file) for file in files]
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error


def _image(path: Path) -> CalibrationImage:
    content = path.read_bytes()
    if path.suffix.lower() in JPEG_SUFFIXES:
        try:
            width, height = read_size(content)
        except CaptureError as error:
            raise CalibrationError(f"{path}: {error}; remove it") from error
    else:
        height, width = decode_grey(content, str(path)).shape
    return CalibrationImage(str(path), width, height, hashlib.sha256(content).hexdigest(), content)


def _video(path: Path) -> list[CalibrationImage]:
    """The sharpest frame of every piece of a video."""
    chosen: dict[int, tuple[float, CalibrationImage]] = {}  # by piece: sharpness, image
    length_s = VIDEO_PIECE_S
    try:
        with VideoSource(path) as source:
            while (frame := source.read()) is not None:
                grey = frame_grey(frame, str(path))
                score = sharpness(grey)
                piece = int(frame.captured_s / length_s)
                if piece not in chosen or score > chosen[piece][0]:
                    chosen[piece] = score, _of_frame(frame, grey, path)
                if len(chosen) > VIDEO_PIECES:  # two pieces become one
                    length_s *= 2
                    best_last = sorted(chosen.items(), key=lambda item: (item[1][0], -item[0]))
                    chosen = {number // 2: found for number, found in best_last}
    except CaptureError as error:
        raise CalibrationError(str(error)) from error
    return [image for _, (_, image) in sorted(chosen.items(), key=lambda item: item[0])]


def _of_frame(frame: Frame, grey: ImageArray, path: Path) -> CalibrationImage:
    content: bytes | ImageArray = bytes(frame.jpeg) if frame.jpeg is not None else grey
    raw = content if isinstance(content, bytes) else content.tobytes()
    name = f"{path} frame {frame.number}"
    digest = hashlib.sha256(raw).hexdigest()
    return CalibrationImage(name, grey.shape[1], grey.shape[0], digest, content, moving=True)


def frame_grey(frame: Frame, name: str) -> ImageArray:
    """[h, w] grey levels of a camera's or a recording's frame."""
    if frame.rgb is not None:
        return np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    return decode_grey(bytes(frame.jpeg or b""), f"{name} frame {frame.number}")


def sharpness(grey: ImageArray) -> float:
    """Compares frames of one scene only: the mean square of the Laplacian, larger is sharper."""
    step = max(1, grey.shape[1] // _SHARPNESS_WIDTH)
    small = cv2.resize(grey, (grey.shape[1] // step, grey.shape[0] // step), interpolation=3)
    return float(np.square(cv2.Laplacian(small, cv2.CV_32F)).mean())
