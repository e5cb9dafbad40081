"""Data sets in COCO's format, read strictly.

The format: cocodataset.org, "Data format", object detection. Boxes are [x, y, width, height] in
pixels from the picture's upper left corner (not from the middle of its first pixel). Entries that
bikeped does not use (licences, addresses, dates) are kept.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import cv2
import msgspec
import numpy as np

from bikeped.capture.jpeg import MAX_PIXELS, JpegDecoder, read_size
from bikeped.capture.opencv import as_rgb, silence_opencv
from bikeped.errors import CaptureError, DataSetError
from bikeped.files import write_whole
from bikeped.types import FloatArray, ImageArray

_JPEG = b"\xff\xd8"
_LARGEST_SIDE = 32768
#: `what` of an image's furniture that is a false positive of a network (`hard_negative_mining`).
FALSE_POSITIVE = "mistaken"
Box = tuple[float, float, float, float]  #: x1, y1, x2, y2 in pixels of a picture


@dataclass(frozen=True)
class CocoImage:
    """One picture: `file_name` in the data set, `path` on the disk, size in pixels.

    `entry` is its whole entry in the data set's `images`.
    """

    id: int
    file_name: str
    width: int
    height: int
    path: Path
    entry: Mapping[str, Any] = field(repr=False, default_factory=dict)


@dataclass(frozen=True)
class CocoObject:
    """One annotation: `box_px` within the picture; a `crowd` is a region of many objects.

    `polygons` are the outlines [n, 2] of its segmentation in picture pixels, empty where it has
    none or a run-length mask. `distance_m` from the camera's foot and `visible`, the share that is
    neither hidden nor outside the picture, are bikeped's additions in drawn pictures.
    """

    id: int
    image_id: int
    category_id: int
    box_px: Box
    crowd: bool = False
    polygons: tuple[FloatArray, ...] = field(repr=False, default=(), compare=False)
    distance_m: float | None = None
    visible: float | None = None


@dataclass(frozen=True)
class CocoData:
    """A data set: pictures and objects by rising id, categories by id.

    `objects`: by picture id; `empty`: number of boxes left out, without area within their picture;
    `sha256`: of the annotation file.
    """

    source: Path
    images: tuple[CocoImage, ...]
    objects: Mapping[int, tuple[CocoObject, ...]]
    categories: Mapping[int, str]
    header: Mapping[str, Any]  #: the rest of the file: info, licenses, categories as given
    empty: int
    sha256: str

    @property
    def count(self) -> int:
        """Objects in all."""
        return sum(len(found) for found in self.objects.values())


class _Image(msgspec.Struct):
    id: int
    file_name: str
    width: int
    height: int


class _Annotation(msgspec.Struct):
    id: int
    image_id: int
    category_id: int
    bbox: Box
    iscrowd: int | bool = 0
    segmentation: Any = None
    distance_m: float | None = None
    visible: float | None = None


class _Category(msgspec.Struct):
    id: int
    name: str


class _File(msgspec.Struct):
    images: list[_Image]
    annotations: list[_Annotation]
    categories: list[_Category]


def read_coco(data: Path, images_dir: Path | None = None) -> CocoData:
    """The data set at `data`: an annotation file, or a folder that holds one.

    A folder holds `annotations.json`, or COCO's own layout: `annotations/instances_NAME.json` with
    the pictures in `NAME/` (`images/NAME/` is found, too). Otherwise `images_dir` names the folder
    that `file_name` starts from. Every picture must exist. Raises DataSetError that names file, key
    and remedy.
    """
    source = _annotation_file(data)
    try:
        content = source.read_bytes()
    except OSError as error:
        raise DataSetError(f"{source}: cannot be read ({error.strerror})") from error
    try:
        raw = msgspec.json.decode(content)
        file = msgspec.convert(raw, _File)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:  # ValidationError is one of these
        raise DataSetError(
            f"{source}: is not COCO's object detection format: {error}; correct it there"
        ) from error
    except RecursionError as error:
        raise DataSetError(f"{source}: is nested too deeply to be COCO's format") from error
    _check_ids(source, "images", (i.id for i in file.images))
    _check_ids(source, "annotations", (a.id for a in file.annotations))
    _check_ids(source, "categories", (c.id for c in file.categories))
    for number, image in enumerate(file.images):
        _check_image(source, number, image)
    _unique(source, "images", "file_name", (i.file_name for i in file.images))
    _unique(source, "categories", "name", (c.name for c in file.categories))
    if not file.images:
        raise DataSetError(f"{source}: images: is empty; name a data set with pictures")
    root = _image_root(source, file.images, images_dir)
    images = [
        CocoImage(i.id, i.file_name, i.width, i.height, root / i.file_name, entry)
        for i, entry in zip(file.images, raw["images"], strict=True)
    ]
    for picture in images:
        if not picture.path.is_file():
            raise DataSetError(
                f"{picture.path}: is missing, but {source} names it (image {picture.id}); add the "
                "picture or remove the entry"
            )
    objects, empty = _objects(source, file, {i.id: i for i in images})
    return CocoData(
        source=source,
        images=tuple(sorted(images, key=lambda i: i.id)),
        objects=objects,
        categories={c.id: c.name for c in sorted(file.categories, key=lambda c: c.id)},
        header={k: v for k, v in raw.items() if k not in ("images", "annotations")},
        empty=empty,
        sha256=hashlib.sha256(content).hexdigest(),
    )


def furniture(image: CocoImage) -> list[tuple[str, Box]]:
    """Fixtures, shadows and false positives of a picture: what each is, and its box within it.

    bikeped's addition to an image's entry (`lab.rendering`): `furniture`, a list of `what` and
    `bbox`, which may reach beyond the picture. Raises DataSetError where it is no such list.
    """
    found: list[tuple[str, Box]] = []
    try:
        for thing in image.entry.get("furniture", ()):
            x, y, width, height = (float(side) for side in thing["bbox"])
            box = _clipped(image, x, y, width, height)
            if box[2] - box[0] >= 1 and box[3] - box[1] >= 1:
                found.append((str(thing["what"]), box))
    except (KeyError, TypeError, ValueError) as error:
        raise DataSetError(
            f"{image.path}: its `furniture` (image {image.id}) is no list of what and bbox; "
            "correct or remove it"
        ) from error
    return found


def read_picture(image: CocoImage) -> ImageArray:
    """The picture, RGB [height, width, 3] uint8; EXIF orientation is ignored, as COCO's boxes do.

    Raises DataSetError for a file that is no whole picture or not of the recorded size.
    """
    try:
        content = image.path.read_bytes()
        _check_size(image, _header_size(content))  # before memory is taken for it
        picture = _decode(content)
    except OSError as error:
        raise DataSetError(f"{image.path}: cannot be read ({error.strerror})") from error
    except (CaptureError, cv2.error) as error:
        why = error.err if isinstance(error, cv2.error) else error
        raise DataSetError(
            f"{image.path}: is no whole picture ({why}); replace it, or remove image {image.id} "
            "from the data"
        ) from error
    _check_size(image, (picture.shape[1], picture.shape[0]))
    return picture


def _check_size(image: CocoImage, size: tuple[int, int] | None) -> None:
    if size is not None and size != (image.width, image.height):
        raise DataSetError(
            f"{image.path}: is {size[0]} x {size[1]} pixels, but the data say {image.width} x "
            f"{image.height} (image {image.id}); correct width and height"
        )


def write_annotations(
    path: Path,
    header: Mapping[str, Any],
    images: Iterable[Mapping[str, Any]],
    annotations: Iterable[Mapping[str, Any]],
) -> None:
    """Writes an annotation file, whole or not at all, entries by rising id."""
    body = {
        **header,
        "images": sorted(images, key=lambda entry: int(entry["id"])),
        "annotations": sorted(annotations, key=lambda entry: int(entry["id"])),
    }
    write_whole(path, json.dumps(body, allow_nan=False, separators=(",", ":")) + "\n")


def _annotation_file(data: Path) -> Path:
    if data.is_file():
        return data
    if not data.is_dir():
        raise DataSetError(f"{data}: does not exist; name an annotation file or its folder")
    plain = data / "annotations.json"
    if plain.is_file():
        return plain
    found = sorted((data / "annotations").glob("instances_*.json")) or sorted(
        (data / "annotations").glob("*.json")
    )
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(file.name for file in found)
        raise DataSetError(f"{data}: holds several data sets ({names}); name one of the files")
    raise DataSetError(
        f"{data}: holds neither annotations.json nor annotations/instances_*.json; name the "
        "annotation file itself"
    )


def _image_root(source: Path, images: list[_Image], images_dir: Path | None) -> Path:
    """The folder that file names start from: the first one that holds the first picture."""
    if images_dir is not None:
        if not images_dir.is_dir():
            raise DataSetError(f"{images_dir}: is no folder; name the one that holds the pictures")
        return images_dir
    above, split = source.parent.parent, source.stem.removeprefix("instances_")
    tried = [source.parent, source.parent / "images"]
    if source.parent.name == "annotations":
        tried = [above / split, above / "images" / split, above / "images", above, *tried]
    for folder in tried:
        if any((folder / image.file_name).is_file() for image in images[:20]):
            return folder
    raise DataSetError(
        f"{source}: images[0].file_name: {images[0].file_name} is missing in "
        f"{', '.join(str(folder) for folder in tried)}; name the pictures' folder with --images"
    )


def _check_image(source: Path, number: int, image: _Image) -> None:
    name = image.file_name
    posix, windows = PurePosixPath(name), PureWindowsPath(name)
    leaves = posix.is_absolute() or windows.anchor != "" or ".." in (*posix.parts, *windows.parts)
    if not name or leaves or "\0" in name or posix == PurePosixPath("."):
        raise DataSetError(
            f"{source}: images[{number}].file_name: {name!r} leads out of the pictures' folder; "
            "use a path below it"
        )
    if not (0 < image.width <= _LARGEST_SIDE and 0 < image.height <= _LARGEST_SIDE):
        raise DataSetError(
            f"{source}: images[{number}]: {image.width} x {image.height} is no picture's size; "
            "correct width and height"
        )
    if image.width * image.height > MAX_PIXELS:
        raise DataSetError(
            f"{source}: images[{number}]: {image.width} x {image.height} pixels are more than "
            f"{MAX_PIXELS}, the most that is read; make the picture smaller"
        )


def _objects(
    source: Path, file: _File, images: Mapping[int, CocoImage]
) -> tuple[dict[int, tuple[CocoObject, ...]], int]:
    categories = {category.id for category in file.categories}
    found: dict[int, list[CocoObject]] = {image_id: [] for image_id in images}
    empty = 0
    for number, entry in enumerate(file.annotations):
        where = f"{source}: annotations[{number}]"
        image = images.get(entry.image_id)
        if image is None:
            raise DataSetError(f"{where}.image_id: there is no image {entry.image_id}; correct it")
        if entry.category_id not in categories:
            raise DataSetError(
                f"{where}.category_id: there is no category {entry.category_id}; correct it"
            )
        if entry.iscrowd not in (0, 1):
            raise DataSetError(f"{where}.iscrowd: {entry.iscrowd} is neither 0 nor 1; correct it")
        if not all(map(math.isfinite, entry.bbox)) or min(entry.bbox[2:]) < 0:
            raise DataSetError(
                f"{where}.bbox: {list(entry.bbox)} is no box; use [x, y, width, height] in pixels"
            )
        box = _clipped(image, *entry.bbox)
        if box[2] <= box[0] or box[3] <= box[1]:
            empty += 1  # COCO's own training set has one of these
            continue
        crowd, polygons = bool(entry.iscrowd), _polygons(where, entry.segmentation)
        found[image.id].append(
            CocoObject(
                *(entry.id, image.id, entry.category_id, box, crowd, polygons),
                *(entry.distance_m, entry.visible),
            )
        )
    ordered = {
        image_id: tuple(sorted(group, key=lambda o: o.id)) for image_id, group in found.items()
    }
    return ordered, empty


def _clipped(image: CocoImage, x: float, y: float, width: float, height: float) -> Box:
    x2, y2 = min(x + width, float(image.width)), min(y + height, float(image.height))
    return max(x, 0.0), max(y, 0.0), x2, y2


def _polygons(where: str, segmentation: object) -> tuple[FloatArray, ...]:
    if not isinstance(segmentation, list):
        return ()  # none, or a run-length mask
    polygons = []
    for ring in segmentation:
        try:
            points = np.asarray(ring, np.float64)
        except (TypeError, ValueError):
            points = np.zeros(1)  # an odd number: refused below
        if points.ndim != 1 or points.size % 2 or not np.isfinite(points).all():
            raise DataSetError(
                f"{where}.segmentation: is no list of [x1, y1, x2, y2, ...]; correct or remove it"
            )
        if points.size >= 6:  # fewer enclose nothing
            polygons.append(points.reshape(-1, 2))
    return tuple(polygons)


def _check_ids(source: Path, part: str, ids: Iterable[int]) -> None:
    numbers = list(ids)
    for number, value in enumerate(numbers):
        if value < 0:
            raise DataSetError(f"{source}: {part}[{number}].id: {value} is negative; correct it")
    _unique(source, part, "id", numbers)


def _unique(source: Path, part: str, key: str, values: Iterable[object]) -> None:
    seen: dict[object, int] = {}
    for number, value in enumerate(values):
        first = seen.setdefault(value, number)
        if first != number:
            raise DataSetError(
                f"{source}: {part}[{number}].{key}: {value!r} is {part}[{first}]'s, too; make it "
                "unique"
            )


def _header_size(content: bytes) -> tuple[int, int] | None:
    """Width and height from a PNG's or JPEG's header, None for other formats."""
    if content[:8] == b"\x89PNG\r\n\x1a\n" and len(content) >= 24:
        return int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
    if content[:2] == _JPEG:
        return read_size(content)
    return None


def _decode(content: bytes) -> ImageArray:
    if content[:2] == _JPEG:
        # A new decoder: the picture must outlive the next call.
        return JpegDecoder(1).decode(content)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    with silence_opencv():
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), flags) if content else None
    if picture is None:
        raise CaptureError("cannot be decoded")
    return as_rgb(np.asarray(picture, np.uint8))
