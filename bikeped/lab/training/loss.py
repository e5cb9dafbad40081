"""Loss of the small network: assignment of cells to objects, classification and box terms.

Cells are assigned as in TOOD (Feng et al. 2021, "task-aligned one-stage object detection"), by
their score for the object's class and the IoU of their box: the score learns the box's quality.
Differences from the paper: a cell may lie up to one fine cell beside a tiny object; and the lower
edge, which is mapped to the ground, has more weight than the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from bikeped.lab.training.network import boxes_px

_SCORE_POWER, _OVERLAP_POWER = 0.5, 6.0  #: of the alignment: score^0.5 * IoU^6
#: The target score is the IoU to this power: boxes of tiny or occluded objects are never as exact,
#: and that must not lower their score.
_TARGET_POWER = 0.15
_CELLS_AN_OBJECT = 10
_LEAST_REACH_PX = 8.0  #: cells this far from the middle of a tiny object are candidates
_EDGE_WEIGHTS = (0.5, 0.5, 0.5, 1.5)  #: left, top, right, bottom
_OVERLAP_GAIN, _EDGE_GAIN = 5.0, 2.0
_TINY = 1e-9


@dataclass(frozen=True)
class ImageLabels:
    """Labels of one picture: `box_px` [m, 4], `class_id` [m] int64, `ignored_px` [k, 4].

    Cells in an ignored box (a crowd, a nearly hidden object) are no negative examples.
    """

    box_px: torch.Tensor
    class_id: torch.Tensor
    ignored_px: torch.Tensor


@dataclass(frozen=True)
class Assignment:
    """For every cell of one picture: `chosen` [cells] bool, `target` [cells] index of its object,
    `quality` [cells] its target score, 0 where not chosen."""

    chosen: torch.Tensor
    target: torch.Tensor
    quality: torch.Tensor


def detection_loss(
    score: torch.Tensor,
    edge: torch.Tensor,
    truths: list[ImageLabels],
    centre: torch.Tensor,
    stride: torch.Tensor,
) -> tuple[torch.Tensor, dict[str, float]]:
    """The loss of a batch, and its parts.

    `score` [n, classes, cells] before the sigmoid and `edge` [n, 4, cells] of `SmallNet`; `truths`
    [n]; `centre` and `stride` of `network.grid`.
    """
    score, box = score.float(), boxes_px(edge.float(), centre, stride)
    wanted = torch.zeros_like(score)
    weight = torch.ones_like(score)
    overlaps, edges, qualities = [], [], []
    for i, truth in enumerate(truths):
        if len(truth.ignored_px):
            weight[i, :, _inside(centre, truth.ignored_px).any(0)] = 0.0
        if not len(truth.box_px):
            continue
        with torch.no_grad():
            given = assign(score[i].sigmoid(), box[i], truth, centre)
        cells = given.chosen.nonzero()[:, 0]
        mine = given.target[cells]
        wanted[i, truth.class_id[mine], cells] = given.quality[cells]
        weight[i, :, cells] = 1.0
        found, true = box[i, cells], truth.box_px[mine]
        overlaps.append(1 - generalised_iou(found, true))
        size = (true[:, 2:] - true[:, :2]).prod(1).sqrt().clamp(min=4.0)
        distance = torch.nn.functional.smooth_l1_loss(
            found / size[:, None], true / size[:, None], reduction="none", beta=0.02
        )
        edges.append((distance * distance.new_tensor(_EDGE_WEIGHTS)).sum(1))
        qualities.append(given.quality[cells])
    cross = torch.nn.functional.binary_cross_entropy_with_logits(score, wanted, reduction="none")
    many = wanted.sum().clamp(min=1.0)
    parts = {"score": (cross * weight).sum() / many}
    if overlaps:
        quality = torch.cat(qualities)
        parts["overlap"] = _OVERLAP_GAIN * (torch.cat(overlaps) * quality).sum() / many
        parts["edge"] = _EDGE_GAIN * (torch.cat(edges) * quality).sum() / many
    # In a batch without objects, too, every weight has a gradient: zero.
    total: Any = sum(parts.values()) + 0.0 * edge.float().sum()
    return total, {name: float(part.detach()) for name, part in parts.items()}


def assign(
    probability: torch.Tensor, box: torch.Tensor, truth: ImageLabels, centre: torch.Tensor
) -> Assignment:
    """Assigns cells of one picture to objects (see the module's docstring).

    `probability` [classes, cells], `box` [cells, 4], `centre` [cells, 2]. Each object takes the
    best-aligned cells; a cell of several objects goes to the one of highest IoU.
    """
    near = _inside(centre, truth.box_px)
    overlap = pairwise_iou(truth.box_px, box) * near
    fit = probability[truth.class_id] ** _SCORE_POWER * overlap**_OVERLAP_POWER
    # An untrained network overlaps nothing: then the nearest cells are taken.
    middle = (truth.box_px[:, None, :2] + truth.box_px[:, None, 2:]) / 2
    nearness = 1 / (1 + (centre[None] - middle).square().sum(2))
    rank = torch.where(near, fit + _TINY * nearness, -1.0)
    best = rank.topk(min(_CELLS_AN_OBJECT, rank.shape[1]), dim=1).indices
    takes = torch.zeros_like(near).scatter_(1, best, True) & near
    several = takes.sum(0) > 1
    if several.any():
        owner = torch.where(takes, overlap, -1.0)[:, several].argmax(0)
        takes[:, several] = False
        takes[owner, several.nonzero()[:, 0]] = True
    fit = fit * takes
    best_overlap = (overlap * takes).amax(1, keepdim=True)
    scale = best_overlap**_TARGET_POWER / (fit.amax(1, keepdim=True) + _TINY)
    chosen = takes.any(0)
    return Assignment(chosen, takes.float().argmax(0), (fit * scale).sum(0) * chosen)


def pairwise_iou(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Intersection over union [n, m] of boxes [n, 4] and [m, 4]."""
    low = torch.maximum(a[:, None, :2], b[None, :, :2])
    high = torch.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = (high - low).clamp(min=0).prod(2)
    return shared / (_area(a)[:, None] + _area(b)[None] - shared + _TINY)


def generalised_iou(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Generalised intersection over union [n] of pairs of boxes, -1..1 (Rezatofighi, 2019)."""
    low, high = torch.maximum(a[:, :2], b[:, :2]), torch.minimum(a[:, 2:], b[:, 2:])
    shared = (high - low).clamp(min=0).prod(1)
    union = _area(a) + _area(b) - shared + _TINY
    around = torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])
    hull = around.clamp(min=0).prod(1) + _TINY
    return shared / union - (hull - union) / hull


def _area(box: torch.Tensor) -> torch.Tensor:
    return (box[:, 2:] - box[:, :2]).clamp(min=0).prod(1)


def _inside(centre: torch.Tensor, box: torch.Tensor) -> torch.Tensor:
    """[m, cells] whether a cell's centre lies in a box [m, 4], tiny boxes taken larger."""
    middle = (box[:, :2] + box[:, 2:]) / 2
    reach = ((box[:, 2:] - box[:, :2]) / 2).clamp(min=_LEAST_REACH_PX)
    return ((centre[None] - middle[:, None]).abs() <= reach[:, None]).all(2)
