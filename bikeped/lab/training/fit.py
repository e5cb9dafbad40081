"""Trains the small network on a data set in COCO's format.

The same data, seed and settings give the same weights on the same kind of processor (PyTorch
guarantees no more). Nothing depends on timing.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import torch

from bikeped.errors import DataSetError
from bikeped.lab.training.coco import CocoData
from bikeped.lab.training.crops import (
    LARGEST_WINDOW_PX,
    Crop,
    Cropper,
    CropSettings,
    Sample,
    object_centres,
    read_sample,
)
from bikeped.lab.training.hard_negative_mining import MiningSettings, mine_false_positives
from bikeped.lab.training.loss import ImageLabels, detection_loss
from bikeped.lab.training.network import STRIDES, SmallNet, grid
from bikeped.lab.training.packing import BLOCK_PX, Packer, PackSettings

_REPORT_EVERY = 100  #: steps
_STEEPEST_GRADIENT = 10.0
_MOMENTUM, _TURNS = 0.95, 5  #: of Muon
_A, _B, _C = 3.4445, -4.7750, 2.0315  #: of Muon's iteration


@dataclass(frozen=True)
class FitSettings:
    """Hyperparameters of the training."""

    steps: int = 6000
    packed: float = 0.85  #: share of the steps, the first ones, on packed squares
    pictures: int = 8  #: per step
    windows: int = 1  #: per picture, in the steps on plain windows
    rate: float = 2e-3  #: peak learning rate of AdamW
    matrix_rate: float = 0.02  #: peak learning rate of Muon, for convolutions; 0: AdamW only
    decay: float = 0.02  #: weight decay
    warmup: int = 100  #: steps until the peak rate
    memory: float = 0.997  #: decay of the moving average of the weights
    seed: int = 0
    workers: int = 2  #: threads, each with a part of every step
    #: Convolutions of the packed steps in bfloat16: 0.8 of the time with hardware support, 6 times
    #: the time without (`small.supports_bfloat16`). The loss and the plain steps are float32.
    bfloat16: bool = False
    device: str = "cpu"
    crops: CropSettings = field(default_factory=CropSettings)
    pack: PackSettings = field(default_factory=PackSettings)
    mining: MiningSettings = field(default_factory=MiningSettings)


@dataclass(frozen=True)
class FitResult:
    """The trained network and the record of its training."""

    network: SmallNet
    names: tuple[str, ...]
    size: tuple[int, int]  #: width and height of the input
    losses: list[dict[str, float]]  #: means over each hundred steps
    mistakes: list[int]  #: false positives of each mining round
    seconds: float


def fit(
    data: CocoData,
    settings: FitSettings,
    progress: Callable[[int], None] = lambda done: None,
    say: Callable[[str], None] = lambda line: None,
) -> FitResult:
    """Trains on `data`; `progress` takes the steps done. Raises DataSetError for unusable data."""
    _check(data, settings)
    began = time.monotonic()
    torch.manual_seed(settings.seed)
    torch.set_num_threads(1)  # of each worker
    torch.use_deterministic_algorithms(True, warn_only=settings.device != "cpu")
    cv2.setNumThreads(1)
    device = torch.device(settings.device)
    network = SmallNet(len(data.categories)).to(device, memory_format=torch.channels_last).train()
    mean = copy.deepcopy(network).eval()
    optimisers = _optimisers(network, settings)
    workers = _workers(network, data, settings)
    losses: list[dict[str, float]] = []
    mistakes: list[int] = []
    sums: dict[str, float] = {}
    rounds = {round(share * settings.steps) for share in settings.mining.after}
    with ThreadPoolExecutor(len(workers)) as pool:
        ready = [pool.submit(worker.prepare, 0) for worker in workers]
        for step in range(settings.steps):
            share = learning_rate(step, settings) / settings.rate
            for optimiser in optimisers:
                for group in optimiser.param_groups:
                    group["lr"] = group["highest"] * share
            for done in ready:
                done.result()
            if step in rounds:
                mined, count = mine_false_positives(
                    copy.deepcopy(mean).cpu(), data, shown_size(settings.crops), settings.mining
                )
                mistakes.append(count)
                say(f"step {step}, {time.monotonic() - began:.0f} s: {count} false positives")
                for worker in workers:
                    worker.data = mined
            answers = [pool.submit(worker.learn) for worker in workers]
            for answer in answers:
                for name, part in answer.result().items():
                    sums[name] = sums.get(name, 0.0) + part / len(workers) / _REPORT_EVERY
            # The next pictures are read during this step.
            if step + 1 < settings.steps:
                ready = [pool.submit(worker.prepare, step + 1) for worker in workers]
            _join(network, workers)
            torch.nn.utils.clip_grad_norm_(network.parameters(), _STEEPEST_GRADIENT)
            for optimiser in optimisers:
                optimiser.step()
            _average(mean, network, min(settings.memory, (1 + step) / (10 + step)))
            progress(step + 1)
            if (step + 1) % _REPORT_EVERY == 0:
                losses.append({name: round(part, 4) for name, part in sums.items()})
                sums = {}
                spent = time.monotonic() - began
                say(f"step {step + 1} of {settings.steps}, {spent:.0f} s: {losses[-1]}")
    return FitResult(
        mean.cpu().eval(),
        tuple(data.categories.values()),
        settings.crops.view,
        losses,
        mistakes,
        time.monotonic() - began,
    )


def shown_size(crops: CropSettings) -> tuple[int, int]:
    """Width and height of a whole frame at the mean scale of the windows, in whole cells."""
    scale, cell = sum(crops.scale) / 2, STRIDES[-1]
    width, height = (max(1, round(side * scale / cell)) * cell for side in crops.view)
    return width, height


def learning_rate(step: int, settings: FitSettings) -> float:
    """Linear warm-up, then half a cosine down to a fiftieth of the peak."""
    if step < settings.warmup:
        return settings.rate * (step + 1) / settings.warmup
    done = (step - settings.warmup) / max(1, settings.steps - settings.warmup)
    return settings.rate * (0.02 + 0.98 * (1 + math.cos(math.pi * done)) / 2)


class _Worker:
    """A part of every step: reads its pictures, cuts its windows and computes its gradient.

    Each has a thread of its own and a copy of the network that shares the weights: threads within
    one operation would synchronise thousands of times a step. Its pictures depend on the seed, the
    step and the part only.
    """

    def __init__(
        self, network: SmallNet, data: CocoData, settings: FitSettings, part: int, cropper: Cropper
    ) -> None:
        self.network = network
        self.data = data  #: read from the next `prepare` on
        self._settings, self._part, self._cropper = settings, part, cropper
        self._device = next(network.parameters()).device
        self._packer = Packer(settings.pack, settings.crops, cropper)
        self._pool: list[Sample] = []
        self._ready: tuple[torch.Tensor, list[ImageLabels]] = (torch.zeros(0), [])
        self._packed = True

    def prepare(self, step: int) -> None:
        """Reads and cuts the windows of the next `learn`."""
        torch.set_num_threads(1)
        self._packed = step < self._settings.packed * self._settings.steps
        crops = self._squares(step) if self._packed else self._crops(step)
        self._ready = _tensors(crops, self._device)
        # Batch statistics of the squares are kept: plain windows are mostly background.
        _keep_statistics(self.network, not self._packed)

    def learn(self) -> dict[str, float]:
        """Computes the gradient of the copy; returns the parts of the loss."""
        torch.set_num_threads(1)
        pictures, truths = self._ready
        half = self._settings.bfloat16 and self._packed
        with torch.autocast(self._device.type, torch.bfloat16, enabled=half):
            score, edge = self.network(pictures)
        centre, stride = grid(pictures.shape[3], pictures.shape[2])
        loss, parts = detection_loss(
            score, edge, truths, centre.to(self._device), stride.to(self._device)
        )
        self.network.zero_grad()
        loss.backward()
        return parts

    def _squares(self, step: int) -> list[Crop]:
        """Packed squares, from a pool of pictures that is renewed step by step."""
        pack, workers = self._settings.pack, self._settings.workers
        # The first step fills the pool.
        end = max(pack.pool, self._settings.pictures) + step * self._settings.pictures
        first = end - self._settings.pictures if step else 0
        self._pool += self._views(range(first, end))
        self._pool = self._pool[-(pack.pool // workers) :]
        random = np.random.default_rng([self._settings.seed, 4, step, self._part])
        return self._packer(self._pool, pack.squares // workers, random)

    def _crops(self, step: int) -> list[Crop]:
        """Plain windows."""
        settings = self._settings
        random = np.random.default_rng([settings.seed, 2, step, self._part])
        mine = range(step * settings.pictures, (step + 1) * settings.pictures)
        self._pool = []
        return [
            self._cropper(view, random)
            for view in self._views(mine)
            for _ in range(settings.windows)
        ]

    def _views(self, numbers: range) -> list[Sample]:
        """This part's share of the pictures `numbers`."""
        return [
            read_sample(self.data, self.data.images[self._picture(n)], self._settings.crops.view)
            for n in numbers[self._part :: self._settings.workers]
        ]

    def _picture(self, number: int) -> int:
        """Every picture once an epoch, in a new order each epoch."""
        count = len(self.data.images)
        turn, place = divmod(number, count)
        return int(np.random.default_rng([self._settings.seed, 3, turn]).permutation(count)[place])


def _workers(network: SmallNet, data: CocoData, settings: FitSettings) -> list[_Worker]:
    """The first one's network is `network` itself; the others share its weights."""
    cropper = Cropper(settings.crops, settings.seed, object_centres(data, settings.crops.view))
    copies = [network]
    for _ in range(settings.workers - 1):
        other = copy.deepcopy(network)
        for own, shared in zip(other.parameters(), network.parameters(), strict=True):
            own.data = shared.data
        copies.append(other)
    return [_Worker(n, data, settings, part, cropper) for part, n in enumerate(copies)]


def _join(network: SmallNet, workers: list[_Worker]) -> None:
    """Averages the workers' gradients and batch statistics into `network`."""
    with torch.no_grad():
        for own, *others in zip(*(w.network.parameters() for w in workers), strict=True):
            if own.grad is not None:
                for other in others:
                    own.grad += other.grad
                own.grad /= len(workers)
        for own, *others in zip(*(w.network.buffers() for w in workers), strict=True):
            if own.dtype.is_floating_point:
                for other in others:
                    own += other
                own /= len(workers)
                for other in others:
                    other.copy_(own)


def _tensors(crops: list[Crop], device: torch.device) -> tuple[torch.Tensor, list[ImageLabels]]:
    stacked = torch.from_numpy(np.stack([crop.rgb for crop in crops])).to(device)
    # The pictures are channels-last in memory already: this copies nothing.
    pictures = stacked.permute(0, 3, 1, 2).float() / 255
    truths = [
        ImageLabels(
            torch.from_numpy(crop.box_px).float().to(device),
            torch.from_numpy(crop.class_id).to(device),
            torch.from_numpy(crop.ignored_px).float().to(device),
        )
        for crop in crops
    ]
    return pictures, truths


def _keep_statistics(network: SmallNet, keep: bool) -> None:
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.train(not keep)


def _optimisers(network: SmallNet, settings: FitSettings) -> list[torch.optim.Optimizer]:
    """Muon for the inner convolutions; AdamW for the last ones, and without weight decay for biases
    and normalisations."""
    last = {
        id(p) for head in network.heads for m in (head.score, head.edge) for p in m.parameters()
    }
    weights = [p for p in network.parameters() if p.ndim > 1]
    within = [p for p in weights if id(p) not in last and settings.matrix_rate > 0]
    taken = {id(p) for p in within}
    groups: list[dict[str, Any]] = [
        {"params": [p for p in weights if id(p) not in taken], "weight_decay": settings.decay},
        {"params": [p for p in network.parameters() if p.ndim <= 1]},
    ]
    found: list[torch.optim.Optimizer] = [
        torch.optim.AdamW(groups, lr=settings.rate, weight_decay=0.0)
    ]
    if within:
        found.append(Muon(within, settings.matrix_rate, settings.decay))
    for optimiser in found:
        for group in optimiser.param_groups:
            group["highest"] = group["lr"]
    return found


def _average(mean: SmallNet, network: SmallNet, share: float) -> None:
    """Updates the moving average of weights and batch statistics."""
    with torch.no_grad():
        for kept, new in zip(
            mean.state_dict().values(), network.state_dict().values(), strict=True
        ):
            if kept.dtype.is_floating_point:
                kept.lerp_(new, 1 - share)
            else:
                kept.copy_(new)


def _check(data: CocoData, settings: FitSettings) -> None:
    sides = (*settings.crops.view, *settings.crops.window)
    if any(side % STRIDES[-1] for side in sides):
        raise DataSetError(
            f"size {sides}: sides must be multiples of {STRIDES[-1]}; choose another --size"
        )
    if settings.pack.side % BLOCK_PX or settings.pack.side > LARGEST_WINDOW_PX:
        raise DataSetError(
            f"squares of {settings.pack.side}: must be multiples of {BLOCK_PX}, and "
            f"{LARGEST_WINDOW_PX} at most"
        )
    if settings.pictures % settings.workers:
        raise DataSetError(
            f"batch {settings.pictures}: must be a multiple of {settings.workers}, so that each "
            "worker has as many pictures; choose another --batch"
        )
    if not data.categories:
        raise DataSetError(f"{data.source}: categories: is empty; name at least one class")
    if not any(not o.crowd for found in data.objects.values() for o in found):
        raise DataSetError(f"{data.source}: holds no object to learn from")


class Muon(torch.optim.Optimizer):  # type: ignore[misc]
    """Orthogonalised momentum for weights of two or more dimensions, those beyond the first
    flattened.

    A few directions dominate the gradient of a convolution; a step of equal length in all
    directions learns the rare ones, too (Jordan et al. 2024, "Muon: an optimizer for hidden layers
    in neural networks"; the coefficients of the iteration are theirs).
    """

    def __init__(self, params: Iterable[torch.Tensor], lr: float, decay: float) -> None:
        super().__init__(params, {"lr": lr, "decay": decay})

    def step(self, closure: Any = None) -> None:
        """One step along the gradients."""
        with torch.no_grad():
            for group in self.param_groups:
                for weight in group["params"]:
                    if weight.grad is not None:
                        self._move(weight, group["lr"], group["decay"])

    def _move(self, weight: torch.Tensor, rate: float, decay: float) -> None:
        state = self.state[weight]
        if not state:
            state["momentum"] = torch.zeros_like(weight)
        state["momentum"].lerp_(weight.grad, 1 - _MOMENTUM)
        ahead = weight.grad.lerp(state["momentum"], _MOMENTUM)
        step = orthogonal(ahead.reshape(len(ahead), -1))
        tall = max(1.0, step.shape[0] / step.shape[1]) ** 0.5
        weight.mul_(1 - rate * decay)
        weight.sub_(step.reshape(weight.shape), alpha=rate * tall)


def orthogonal(matrix: torch.Tensor) -> torch.Tensor:
    """`matrix` [n, m] with its singular values moved near one (0.7 to 1.2)."""
    wide = matrix.shape[0] <= matrix.shape[1]
    x = matrix if wide else matrix.T
    x = x / (x.norm() + 1e-7)
    for _ in range(_TURNS):
        square = x @ x.T
        x = _A * x + (_B * square + _C * square @ square) @ x
    return x if wide else x.T
