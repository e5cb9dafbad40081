"""Weight files of the small network; reading one executes nothing in it."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from bikeped.errors import DetectorError
from bikeped.files import write_whole
from bikeped.lab.training.network import SmallNet

FORMAT = "bikeped small detector 2"


@dataclass(frozen=True)
class SmallDetector:
    """The small network with what its files record: class names, input size (width, height) and
    facts about its training (plain values)."""

    network: SmallNet
    names: tuple[str, ...]
    size: tuple[int, int]
    facts: dict[str, Any] = field(default_factory=dict)


def save_weights(detector: SmallDetector, path: Path) -> None:
    """Writes a weight file, whole or not at all."""
    file = io.BytesIO()
    body = {
        "format": FORMAT,
        "names": list(detector.names),
        "size": list(detector.size),
        "facts": detector.facts,
        "weights": detector.network.state_dict(),
    }
    torch.save(body, file)
    write_whole(path, file.getvalue())


def is_small(path: Path) -> bool:
    """Whether a file holds weights of the small network; DetectorError where it holds none."""
    return _read(path).get("format") == FORMAT


def load_weights(path: Path) -> SmallDetector:
    """Reads a weight file, the network in evaluation mode; DetectorError where it is none."""
    body = _read(path)
    if body.get("format") != FORMAT:
        raise DetectorError(
            f"{path}: holds no weights of bikeped's small network; name the weights.pt that "
            "`bikeped model train --network small` wrote"
        )
    try:
        names = tuple(str(name) for name in body["names"])
        width, height = (int(side) for side in body["size"])
        network = SmallNet(len(names))
        network.load_state_dict(body["weights"])
        return SmallDetector(network.eval(), names, (width, height), dict(body["facts"]))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise DetectorError(f"{path}: its weights do not fit ({_line(error)})") from error


def _read(path: Path) -> dict[str, Any]:
    try:
        body = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise DetectorError(f"{path}: cannot be read ({error.strerror})") from error
    except Exception as error:  # a damaged file raises anything
        # Its text may advise to load the file without the protection against what it runs.
        raise DetectorError(
            f"{path}: is no file of weights; name the weights.pt that `bikeped model train` wrote"
        ) from error
    return body if isinstance(body, dict) else {}


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
