"""What a camera that fails shows: the pictures of a loopback camera, changed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import lru_cache

import cv2
import numpy as np

from bikeped.types import ImageArray
from campaign.camera import encode, street_picture

SIZE = (320, 212)
Change = Callable[[ImageArray], ImageArray]


@lru_cache(maxsize=1)
def street_pictures() -> tuple[ImageArray, ...]:
    """A minute of the drawn street at 10 pictures a second."""
    return tuple(street_picture(number, SIZE) for number in range(600))


def changed(change: Change, noise: float = 2.0) -> Iterator[bytes]:
    """The street after `change`, with the sensor's fresh noise on every picture."""
    rng = np.random.default_rng(3)
    for rgb in itertools.cycle(street_pictures()):
        noisy = change(rgb) + rng.normal(0, noise, rgb.shape)
        yield encode(np.clip(noisy, 0, 255).astype(np.uint8))


def one_colour(*rgb: int) -> Change:
    return lambda picture: np.full_like(picture, np.array(rgb, np.uint8))


def covered(share: float) -> Change:
    """A hand or a bag over the left `share` of the picture."""

    def change(picture: ImageArray) -> ImageArray:
        out = picture.copy()
        out[:, : round(share * picture.shape[1])] = (22, 20, 18)
        return out

    return change


def defocused(sigma_px: float) -> Change:
    return lambda picture: np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma_px), np.uint8)


def drops(number: int) -> Change:
    """Drops on the lens: discs in which the picture is blurred and bright."""
    rng = np.random.default_rng(11)
    mask = np.zeros((SIZE[1], SIZE[0]), np.float32)
    for _ in range(number):
        centre = (int(rng.integers(0, SIZE[0])), int(rng.integers(0, SIZE[1])))
        cv2.circle(mask, centre, int(rng.integers(12, 30)), 1.0, -1)
    soft = cv2.GaussianBlur(mask, (0, 0), 3)[..., None]

    def change(picture: ImageArray) -> ImageArray:
        blurred = cv2.GaussianBlur(picture, (0, 0), 9) * 0.8 + 45
        return np.asarray(picture * (1 - soft) + blurred * soft, np.uint8)

    return change


def turned(up_px: float = 0.0, roll_deg: float = 0.0) -> Change:
    """A camera that looks higher by so many pixels, or is rolled."""
    matrix = cv2.getRotationMatrix2D((SIZE[0] / 2, SIZE[1] / 2), roll_deg, 1.0)
    matrix[1, 2] += up_px

    def change(picture: ImageArray) -> ImageArray:
        turned_picture = cv2.warpAffine(picture, matrix, SIZE, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(turned_picture, np.uint8)

    return change


def night(picture: ImageArray) -> ImageArray:
    """Very dark, with two lamps."""
    out = (picture * 0.09 + 4).astype(np.uint8)
    cv2.circle(out, (60, 30), 6, (235, 225, 190), -1)
    cv2.circle(out, (250, 40), 5, (240, 230, 200), -1)
    return out


def rain(picture: ImageArray) -> ImageArray:
    """Streaks that are elsewhere in every picture, less contrast."""
    rng = np.random.default_rng(int(picture[::7, ::7].sum()))
    out = (picture * 0.7 + 40).astype(np.uint8)
    for u, v in rng.integers((0, 0), SIZE, (160, 2)):
        cv2.line(out, (int(u), int(v)), (int(u) + 2, int(v) + 12), (190, 190, 195), 1)
    return out


def low_sun(picture: ImageArray) -> ImageArray:
    """A glare that saturates a quarter of the picture."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    glare = 320 * np.exp(-((u - 240) ** 2 + (v - 40) ** 2) / (2 * 55**2))
    return np.clip(picture + glare[..., None], 0, 255).astype(np.uint8)
