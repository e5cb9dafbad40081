"""Suppression: equal to the plain greedy loop and to OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.detection.nms import non_max_suppression, vote_boxes
from bikeped.geometry.boxes import iou_matrix


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
    return iou_matrix(a[None], b[None])[0, 0]


def scene(n, seed, groups=3, crowd=None):
    """`n` boxes, many of them jittered copies of a few, as a network answers."""
    rng = np.random.default_rng(seed)
    heart = rng.uniform(0, 600, (crowd or max(n // 10, 1), 2))
    centre = heart[rng.integers(0, len(heart), n)] + rng.normal(0, 6, (n, 2))
    size = rng.uniform(20, 80, (n, 2))
    box = np.concatenate([centre - size / 2, centre + size / 2], axis=1).astype(np.float32)
    score = np.round(rng.uniform(0.1, 1, n), 2).astype(np.float32)  # rounded: ties happen
    return box, score, rng.integers(0, groups, n).astype(np.int8)


def test_an_overlap_of_exactly_the_threshold_suppresses_nothing():
    pair = np.array([[0, 0, 2, 1], [0, 0, 1, 1]], np.float32)
    far = 10 + 4 * np.arange(199, dtype=np.float32)[:, None] + np.array([0, 0, 1, 1], np.float32)
    for box in (pair, np.concatenate([pair[:1], far, pair[1:]])):  # in one block, and in two
        score = np.linspace(1, 0.5, len(box)).astype(np.float32)
        assert len(non_max_suppression(box, score, np.zeros(len(box)), 0.5, 1000)) == len(box)
        assert len(non_max_suppression(box, score, np.zeros(len(box)), 0.499, 1000)) < len(box)


@pytest.mark.parametrize(("n", "crowd"), [(0, 1), (1, 1), (300, None), (700, 3), (700, 600)])
@pytest.mark.parametrize("iou", [0.1, 0.45, 0.9])
def test_equal_to_the_plain_loop(n, crowd, iou):
    box, score, group = scene(n, seed=n, crowd=crowd)
    assert non_max_suppression(box, score, group, iou, 10_000).tolist() == plain(
        box, score, group, iou, 10_000
    )


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 260), st.integers(1, 5), st.floats(0.01, 1))
def test_equal_to_the_plain_loop_on_any_scene(seed, n, crowd, iou):
    box, score, group = scene(n, seed, crowd=crowd)
    assert non_max_suppression(box, score, group, iou, 50).tolist() == plain(
        box, score, group, iou, 50
    )


def test_equal_to_opencv():
    box, _, group = scene(400, seed=5)
    score = np.random.default_rng(5).permutation(np.linspace(0.1, 1, 400)).astype(np.float32)
    xywh = np.concatenate([box[:, :2], box[:, 2:] - box[:, :2]], axis=1)
    theirs = cv2.dnn.NMSBoxesBatched(xywh.tolist(), score.tolist(), group.tolist(), 0.0, 0.45)
    ours = non_max_suppression(box, score, group, 0.45, 10_000)
    assert sorted(ours.tolist()) == sorted(np.asarray(theirs).ravel().tolist())


def test_a_chain_is_settled_greedily():
    # Each overlaps the next only: the greedy answer keeps every other one.
    box = np.array([[4 * i, 0, 4 * i + 10, 10] for i in range(9)], np.float32)
    score = np.linspace(0.9, 0.1, 9).astype(np.float32)
    kept = non_max_suppression(box, score, np.zeros(9), 0.4, 100)
    assert kept.tolist() == [0, 2, 4, 6, 8]


def test_groups_do_not_suppress_one_another_and_ties_keep_their_order():
    box = np.array([[0, 0, 10, 10]] * 4, np.float32)
    score = np.full(4, 0.5, np.float32)
    assert non_max_suppression(box, score, np.array([1, 0, 0, 1]), 0.5, 100).tolist() == [0, 1]


def test_most_is_the_strongest():
    box = np.array([[20 * i, 0, 20 * i + 10, 10] for i in range(500)], np.float32)
    score = np.linspace(0.1, 0.9, 500).astype(np.float32)
    assert non_max_suppression(box, score, np.zeros(500), 0.5, 3).tolist() == [499, 498, 497]


def plainly_merged(box, score, group, keep, overlap):
    """One kept box at a time, one neighbour at a time."""
    rows = []
    for i in keep:
        near = [
            k
            for k in range(len(box))
            if k == i or (group[k] == group[i] and one_overlap(box[i], box[k]) >= overlap)
        ]
        rows.append(np.average(box[near].astype(float), axis=0, weights=score[near].astype(float)))
    return np.array(rows).reshape(-1, 4)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(0, 120), st.integers(1, 5), st.floats(0.5, 0.99))
def test_merging_equals_the_plain_loop(seed, n, crowd, overlap):
    box, score, group = scene(n, seed, crowd=crowd)
    keep = non_max_suppression(box, score, group, 0.45, 50)
    merged = vote_boxes(box, score, group, keep, overlap)
    np.testing.assert_allclose(
        merged, plainly_merged(box, score, group, keep, overlap), rtol=1e-4, atol=1e-3
    )
    # Whoever is moved, is moved within what was boxed there.
    assert (iou_matrix(merged, box[keep]).diagonal() >= overlap**2 - 1e-4).all()


def test_merging_takes_the_stronger_more_into_account_and_other_kinds_not_at_all():
    box = np.array([[0, 0, 10, 20], [0, 0, 10, 24], [0, 0, 10, 18]], np.float32)
    score = np.array([0.6, 0.2, 0.5], np.float32)
    kept = vote_boxes(box, score, np.array([0, 0, 1]), np.array([0, 2]), 0.75)
    np.testing.assert_allclose(kept, [[0, 0, 10, 21], [0, 0, 10, 18]], rtol=1e-6)


def test_nothing_is_merged_at_one_and_a_box_without_area_stays():
    box, score, group = scene(60, seed=3)
    keep = non_max_suppression(box, score, group, 0.45, 50)
    assert np.array_equal(vote_boxes(box, score, group, keep, 1.0), box[keep])
    flat = np.array([[5, 5, 5, 5]], np.float32)
    one = vote_boxes(flat, np.ones(1, np.float32), np.zeros(1), np.zeros(1, np.int64), 0.75)
    assert one.tolist() == flat.tolist()
