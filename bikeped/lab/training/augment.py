"""Fisheye augmentation: warps a data set of ordinary pictures into fisheye pictures.

Each result depends only on the seed, the picture's id and the number of the copy, not on order or
processes. The new data set appears whole or not at all.
"""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bikeped import __version__
from bikeped.errors import DataSetError
from bikeped.files import whole_folder
from bikeped.lab.process_pool import worker_pool
from bikeped.lab.training.coco import (
    CocoData,
    CocoImage,
    CocoObject,
    furniture,
    read_picture,
    write_annotations,
)
from bikeped.lab.training.warp import Warp, WarpRanges, sample_warp, warp_boxes, warp_picture
from bikeped.types import BoolArray, FloatArray, ImageArray

#: An object is dropped when less than this share of its area is left, or a side of its box is
#: shorter than this in the new picture.
LEAST_SHARE, LEAST_SIDE_PX = 0.3, 3.0
JPEG_QUALITY = 95
_BATCH = 8  # pictures a job: few enough that all processes end at about the same time
_SMALL = 8  # with fewer pictures, starting processes takes longer than the work


@dataclass(frozen=True)
class AugmentSettings:
    """How a data set is augmented."""

    ranges: WarpRanges = field(default_factory=WarpRanges)
    seed: int = 0
    copies: int = 1
    least_share: float = LEAST_SHARE
    processes: int = 2

    def __post_init__(self) -> None:
        if self.copies < 1 or self.processes < 1 or self.seed < 0:
            raise DataSetError("copies and processes: at least 1; seed: at least 0")
        if not 0 <= self.least_share <= 1:
            raise DataSetError(f"least-share: {self.least_share} is not within 0 to 1")


@dataclass(frozen=True)
class AugmentSummary:
    """Counts of an augmentation."""

    folder: Path
    pictures: int
    objects: int
    dropped: int  #: objects of which too little was left
    empty: int  #: boxes of the source without area, left out
    by_category: Mapping[str, int]
    seed: int

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        body = asdict(self)
        return body | {"folder": str(self.folder), "boxes_without_area": body.pop("empty")}


def augment_picture(
    image: ImageArray,
    box_px: npt.ArrayLike,
    warp: Warp,
    *,
    polygons: Sequence[Sequence[FloatArray]] | None = None,
    crowd: npt.ArrayLike | None = None,
    least_share: float = LEAST_SHARE,
    least_side_px: float = LEAST_SIDE_PX,
) -> tuple[ImageArray, FloatArray, BoolArray]:
    """A picture [h, w, 3] and its boxes [n, 4] (x1, y1, x2, y2) through one lens.

    Returns the new picture [size, size, 3], the boxes [n, 4] in it and which of them are kept [n]:
    at least `least_share` of the object's area is visible and its box measures `least_side_px` each
    way. A crowd region is kept while anything of it is visible, for its area is not evaluated.
    Boxes that are not kept may be NaN. Pure.
    """
    high, wide = image.shape[:2]
    boxes, share = warp_boxes(warp, (wide, high), box_px, polygons)
    many = np.asarray(np.zeros(len(boxes)) if crowd is None else crowd, np.bool_)
    side = (boxes[:, 2:] - boxes[:, :2]).min(axis=1, initial=np.inf)
    with np.errstate(invalid="ignore"):
        kept = (side >= least_side_px) & (share >= least_share)
        kept |= many & (side > 0)
    return warp_picture(image, warp), boxes, kept


def picture_generator(seed: int, image_id: int, copy: int) -> np.random.Generator:
    """Random numbers of one copy of one picture, independent of the order of work."""
    return np.random.default_rng([seed, image_id, copy])


def augment_data(
    data: CocoData,
    out: Path,
    settings: AugmentSettings,
    progress: Callable[[int], None] = lambda done: None,
) -> AugmentSummary:
    """Writes the augmented data set to the new folder `out`: `annotations.json` and `images/`.

    The source's licences, info and entries are kept; every picture records its lens. Raises
    DataSetError, and leaves no `out`, where a picture cannot be read.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    dropped = 0
    with _whole_folder(data, out) as folder:
        (folder / "images").mkdir()
        for done, made in enumerate(_results(data, folder / "images", settings), 1):
            entries, found, lost = made
            images += entries
            annotations += found
            dropped += lost
            progress(done)
        write_annotations(folder / "annotations.json", _header(data, settings), images, annotations)
    counts = dict.fromkeys(data.categories.values(), 0)
    for annotation in annotations:
        counts[data.categories[annotation["category_id"]]] += 1
    return AugmentSummary(
        out, len(images), len(annotations), dropped, data.empty, counts, settings.seed
    )


_Made = tuple[list[dict[str, Any]], list[dict[str, Any]], int]


def _results(data: CocoData, folder: Path, settings: AugmentSettings) -> Iterator[_Made]:
    """The results of all source pictures, in any order."""
    jobs = [(image, data.objects[image.id]) for image in data.images]
    if settings.processes == 1 or len(jobs) * settings.copies <= _SMALL:
        for job in jobs:
            yield _copies(*job, folder, settings)
        return
    batches = iter([jobs[at : at + _BATCH] for at in range(0, len(jobs), _BATCH)])
    with worker_pool(settings.processes) as pool:
        # Only a few batches ahead, to bound the memory of waiting results.
        ahead = {
            pool.submit(_batch, batch, folder, settings)
            for batch in islice(batches, 3 * settings.processes)
        }
        while ahead:
            finished, ahead = concurrent.futures.wait(
                ahead, return_when=concurrent.futures.FIRST_COMPLETED
            )
            for future in finished:
                yield from future.result()
            for batch in islice(batches, len(finished)):
                ahead.add(pool.submit(_batch, batch, folder, settings))


def _batch(
    jobs: list[tuple[CocoImage, tuple[CocoObject, ...]]], folder: Path, settings: AugmentSettings
) -> list[_Made]:
    cv2.setNumThreads(1)  # the processes share the cores already
    return [_copies(*job, folder, settings) for job in jobs]


def _copies(
    image: CocoImage, objects: tuple[CocoObject, ...], folder: Path, settings: AugmentSettings
) -> _Made:
    """Draws all copies of one picture; their entries, annotations, and how many were dropped."""
    picture = read_picture(image)
    standing = furniture(image)
    entries: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    lost, count = 0, len(objects)
    for copy in range(settings.copies):
        warp = sample_warp(picture_generator(settings.seed, image.id, copy), settings.ranges)
        drawn, every_box, every_kept = augment_picture(
            picture,
            [*(thing.box_px for thing in objects), *(box for _, box in standing)],
            warp,
            polygons=[*(thing.polygons for thing in objects), *(() for _ in standing)],
            crowd=[*(thing.crowd for thing in objects), *(False for _ in standing)],
            least_share=settings.least_share,
        )
        boxes, kept = every_box[:count], every_kept[:count]
        name = f"{image.id:012d}_{copy}.jpg"
        _write_jpeg(folder / name, drawn)
        new_id = image.id * settings.copies + copy
        rest = zip(standing, every_box[count:].tolist(), every_kept[count:], strict=True)
        things = [{"what": what, "bbox": _bbox(box)} for (what, _), box, keep in rest if keep]
        entries.append(
            {
                **image.entry,
                **({"furniture": things} if "furniture" in image.entry else {}),
                "id": new_id,
                "file_name": f"images/{name}",
                "width": warp.size_px,
                "height": warp.size_px,
                "source": {"id": image.id, "file_name": image.file_name},
                "warp": warp.as_dict(),
            }
        )
        for thing, box, keep in zip(objects, boxes.tolist(), kept.tolist(), strict=True):
            if keep:
                annotations.append(_annotation(thing, box, new_id, copy, settings.copies))
            else:
                lost += 1
    return entries, annotations, lost


def _annotation(
    thing: CocoObject, box: Sequence[float], image_id: int, copy: int, copies: int
) -> dict[str, Any]:
    bbox = _bbox(box)
    return {
        "id": thing.id * copies + copy,
        "image_id": image_id,
        "category_id": thing.category_id,
        "bbox": bbox,
        "area": round(bbox[2] * bbox[3], 3),
        "iscrowd": int(thing.crowd),
    }


def _bbox(box: Sequence[float]) -> list[float]:
    """COCO's x, y, width, height of x1, y1, x2, y2."""
    # Three decimals are far finer than a mark by hand.
    x1, y1, x2, y2 = (round(value, 3) for value in box)
    return [x1, y1, round(x2 - x1, 3), round(y2 - y1, 3)]


def _header(data: CocoData, settings: AugmentSettings) -> dict[str, Any]:
    info = data.header.get("info")
    record = {
        "what": "fisheye augmentation by bikeped model augment",
        "version": __version__,
        "source": data.source.name,
        "source_sha256": data.sha256,
        "seed": settings.seed,
        "copies": settings.copies,
        "least_share": settings.least_share,
        "ranges": asdict(settings.ranges),
        "area": "of the box: segmentations are not carried along",
    }
    return {**data.header, "info": {**(info if isinstance(info, dict) else {}), "bikeped": record}}


def _write_jpeg(path: Path, picture: ImageArray) -> None:
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    ok, content = cv2.imencode(".jpg", bgr, [int(cv2.IMWRITE_JPEG_QUALITY), JPEG_QUALITY])
    if not ok:
        raise DataSetError(f"{path}: the picture cannot be written as JPEG")
    try:
        path.write_bytes(content.tobytes())
    except OSError as error:
        raise DataSetError(f"{path}: cannot be written ({error.strerror})") from error


@contextmanager
def _whole_folder(data: CocoData, out: Path) -> Iterator[Path]:
    """A folder beside `out` that is renamed to `out` after success, else removed."""
    target = out.resolve()
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise DataSetError(f"--out {out}: exists already; name a new folder")
    sources = {data.source.resolve().parent, *(i.path.resolve().parent for i in data.images)}
    for source in sources:
        if target == source or source in target.parents:
            raise DataSetError(
                f"--out {out}: lies in the data's own folder {source}; name a folder beside it"
            )
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataSetError(f"--out {out}: cannot be made ({error.strerror})") from error
    try:
        with whole_folder(target) as folder:
            yield folder
    except OSError as error:
        raise DataSetError(f"--out {out}: cannot be written ({error.strerror})") from error
