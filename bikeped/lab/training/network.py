"""bikeped's small detector: a one-stage, anchor-free convolutional network of 700,000 weights.

Each cell of three grids of strides 8, 16 and 32 pixels predicts a score for each class and the
distances of the box's four edges from the cell's centre. Only plain convolutions and ReLU, which
all runtimes optimise. Reading a weight file executes nothing in it.

    stem    3 -> 16 -> 32 channels at 1/4 of the picture's size
    stages  64, 112, 160 channels at 1/8, 1/16, 1/32; each a few convolutions on half of the
            channels, all outputs concatenated (as in CSP and ELAN networks)
    neck    from coarse to fine, to give small objects context
    heads   one convolution, then scores and edges
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

from bikeped.errors import DetectorError
from bikeped.files import write_whole

STRIDES = (8, 16, 32)
#: Initial score of a cell (RetinaNet, section 4.1).
_PRIOR = 0.01


class _Conv(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(self, taken: int, given: int, size: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(taken, given, size, stride, size // 2, bias=False)
        self.norm = nn.BatchNorm2d(given, eps=1e-3, momentum=0.03)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.norm(self.conv(x)))


class _Stage(nn.Module):
    """`count` convolutions in a row on half of the channels; all their outputs are concatenated."""

    def __init__(self, channels: int, count: int) -> None:
        super().__init__()
        half = channels // 2
        self.enter = _Conv(channels, channels, 1)
        self.steps = nn.ModuleList([_Conv(half, half) for _ in range(count)])
        self.leave = _Conv(half * (2 + count), channels, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        parts = list(self.enter(x).chunk(2, 1))
        for step in self.steps:
            parts.append(step(parts[-1]))
        return self.leave(torch.cat(parts, 1))


class _Head(nn.Module):
    """Scores (before the sigmoid) and edges (in strides) of one grid."""

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.trunk = _Conv(channels, channels)
        self.score = nn.Conv2d(channels, classes, 1)
        self.edge = nn.Conv2d(channels, 4, 1)
        nn.init.constant_(self.score.bias, -math.log((1 - _PRIOR) / _PRIOR))
        nn.init.constant_(self.edge.bias, 1.0)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x = self.trunk(x)
        return self.score(x).flatten(2), self.edge(x).flatten(2)


class SmallNet(nn.Module):
    """Pictures [n, 3, h, w], RGB in 0..1, sides multiples of 32; see `forward` and `detect`."""

    def __init__(
        self,
        classes: int,
        widths: tuple[int, ...] = (16, 32, 64, 112, 160),
        depths: tuple[int, ...] = (2, 3, 2),
        neck: int = 48,
    ) -> None:
        super().__init__()
        self.classes = classes
        first, second, *stages = widths
        self.stem = nn.Sequential(
            _Conv(3, first, stride=2), _Conv(first, second, stride=2), _Stage(second, 1)
        )
        self.stages = nn.ModuleList()
        taken = second
        for given, count in zip(stages, depths, strict=True):
            self.stages.append(nn.Sequential(_Conv(taken, given, stride=2), _Stage(given, count)))
            taken = given
        self.lateral = nn.ModuleList([_Conv(given, neck, 1) for given in stages])
        self.merge = nn.ModuleList([_Stage(neck, 1) for _ in stages[:-1]])
        self.heads = nn.ModuleList([_Head(neck, classes) for _ in stages])

    def forward(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Scores before the sigmoid [n, classes, cells] and edges [n, 4, cells].

        Edges are the distances from the cell's centre to the box's left, top, right and bottom, in
        strides. Cells run through the grids of `STRIDES` one after another, row by row.
        """
        x = self.stem(pictures)
        maps = []
        for stage, lateral in zip(self.stages, self.lateral, strict=True):
            x = stage(x)
            maps.append(lateral(x))
        for i in reversed(range(len(self.merge))):
            maps[i] = self.merge[i](
                maps[i] + nn.functional.interpolate(maps[i + 1], scale_factor=2)
            )
        answers = [head(x) for head, x in zip(self.heads, maps, strict=True)]
        return torch.cat([a[0] for a in answers], 2), torch.cat([a[1] for a in answers], 2)


class ExportModule(nn.Module):
    """The network with its output in the layout `yolov8`: [n, 4 + classes, cells].

    Rows: centre u, centre v, width, height in pixels of the input, then a score in 0..1 a class.
    """

    def __init__(self, network: SmallNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        score, edge = self.network(images)
        # From the picture's own size: the exported network takes any.
        centre, stride = grid(images.shape[3], images.shape[2])
        low, high = edge[:, :2], edge[:, 2:]
        middle = centre.T[None] + (high - low) * (stride / 2)
        return torch.cat([middle, (low + high) * stride, score.sigmoid()], 1)


def grid(width: int, height: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Centre [cells, 2] (u, v) and stride [cells] of every cell, in pixels of the input."""
    centres, strides = [], []
    for stride in STRIDES:
        v, u = torch.meshgrid(
            torch.arange(height // stride), torch.arange(width // stride), indexing="ij"
        )
        centres.append((torch.stack([u.flatten(), v.flatten()], 1) + 0.5) * stride)
        strides.append(torch.full_like(centres[-1][:, 0], float(stride)))
    return torch.cat(centres), torch.cat(strides)


def boxes_px(edge: torch.Tensor, centre: torch.Tensor, stride: torch.Tensor) -> torch.Tensor:
    """Corners [n, cells, 4] (u1, v1, u2, v2) in pixels, of edges [n, 4, cells]."""
    reach = edge.permute(0, 2, 1) * stride[None, :, None]
    return torch.cat([centre - reach[..., :2], centre + reach[..., 2:]], 2)


def multiply_adds(network: Any, width: int, height: int) -> int:
    """Multiplications of all convolutions for one picture."""
    total = 0

    def count(module: Any, _: Any, answer: torch.Tensor) -> None:
        nonlocal total
        total += answer[0].numel() * module.weight[0].numel()

    hooks = [m.register_forward_hook(count) for m in network.modules() if isinstance(m, nn.Conv2d)]
    training = network.training
    with torch.no_grad():
        network.eval()(torch.zeros(1, 3, height, width))
    network.train(training)
    for hook in hooks:
        hook.remove()
    return total


def shift_scores(network: SmallNet, score: Sequence[float], becomes: float) -> None:
    """Shifts each class's scores, in log odds, so that its `score` becomes `becomes`.

    So one configured threshold stands for the best one of each class.
    """
    odds = torch.tensor([math.log(p / (1 - p)) for p in (*score, becomes)])
    with torch.no_grad():
        for head in network.heads:
            head.score.bias += odds[-1] - odds[:-1]


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
