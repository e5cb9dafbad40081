"""Suppression: equal to the plain greedy loop and to OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.detection.nms import overlap_matrix, suppress


def plain(box, score, group, iou, most):
    """The textbook loop, one pair at a time."""
    kept = []
    for i in sorted(range(len(score)), key=lambda k: (-score[k], k)):
        if len(kept) == most:
            break
        if all(group[i] != group[k] or one_overlap(box[i], box[k]) <= iou for k in kept):
            kept.append(i)
    return kept


def one_overlap(a, b):
    return overlap_matrix(a[None], b[None])[0, 0]


def scene(n, seed, groups=3, crowd=None):
    """`n` boxes, many of them jittered copies of a few, as a network answers."""
    rng = np.random.default_rng(seed)
    heart = rng.uniform(0, 600, (crowd or max(n // 10, 1), 2))
    centre = heart[rng.integers(0, len(heart), n)] + rng.normal(0, 6, (n, 2))
    size = rng.uniform(20, 80, (n, 2))
    box = np.concatenate([centre - size / 2, centre + size / 2], axis=1).astype(np.float32)
    score = np.round(rng.uniform(0.1, 1, n), 2).astype(np.float32)  # rounded: ties happen
    return box, score, rng.integers(0, groups, n).astype(np.int8)


def test_overlap_by_hand():
    box = np.array([[0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30]], np.float32)
    expected = [[1, 1 / 3, 0], [1 / 3, 1, 0], [0, 0, 1]]
    np.testing.assert_allclose(overlap_matrix(box, box), expected, rtol=1e-6)


@pytest.mark.parametrize(("n", "crowd"), [(0, 1), (1, 1), (300, None), (700, 3), (700, 600)])
@pytest.mark.parametrize("iou", [0.1, 0.45, 0.9])
def test_equal_to_the_plain_loop(n, crowd, iou):
    box, score, group = scene(n, seed=n, crowd=crowd)
    assert suppress(box, score, group, iou, 10_000).tolist() == plain(
        box, score, group, iou, 10_000
    )


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 260), st.integers(1, 5), st.floats(0.01, 1))
def test_equal_to_the_plain_loop_on_any_scene(seed, n, crowd, iou):
    box, score, group = scene(n, seed, crowd=crowd)
    assert suppress(box, score, group, iou, 50).tolist() == plain(box, score, group, iou, 50)


def test_equal_to_opencv():
    box, _, group = scene(400, seed=5)
    score = np.random.default_rng(5).permutation(np.linspace(0.1, 1, 400)).astype(np.float32)
    xywh = np.concatenate([box[:, :2], box[:, 2:] - box[:, :2]], axis=1)
    theirs = cv2.dnn.NMSBoxesBatched(xywh.tolist(), score.tolist(), group.tolist(), 0.0, 0.45)
    ours = suppress(box, score, group, 0.45, 10_000)
    assert sorted(ours.tolist()) == sorted(np.asarray(theirs).ravel().tolist())


def test_a_chain_is_settled_greedily():
    # Each overlaps the next only: the greedy answer keeps every other one.
    box = np.array([[4 * i, 0, 4 * i + 10, 10] for i in range(9)], np.float32)
    score = np.linspace(0.9, 0.1, 9).astype(np.float32)
    kept = suppress(box, score, np.zeros(9), 0.4, 100)
    assert kept.tolist() == [0, 2, 4, 6, 8]


def test_groups_do_not_suppress_one_another_and_ties_keep_their_order():
    box = np.array([[0, 0, 10, 10]] * 4, np.float32)
    score = np.full(4, 0.5, np.float32)
    assert suppress(box, score, np.array([1, 0, 0, 1]), 0.5, 100).tolist() == [0, 1]


def test_most_is_the_strongest():
    box = np.array([[20 * i, 0, 20 * i + 10, 10] for i in range(500)], np.float32)
    score = np.linspace(0.1, 0.9, 500).astype(np.float32)
    assert suppress(box, score, np.zeros(500), 0.5, 3).tolist() == [499, 498, 497]
