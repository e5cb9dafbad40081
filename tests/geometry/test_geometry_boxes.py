"""Area, intersection and overlap of boxes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bikeped.geometry.boxes import box_area, intersection_area, iou_matrix


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_overlap_by_hand(dtype):
    box = np.array([[0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30]], dtype)
    expected = [[1, 1 / 3, 0], [1 / 3, 1, 0], [0, 0, 1]]
    table = iou_matrix(box, box)
    assert table.dtype == dtype
    np.testing.assert_allclose(table, expected, rtol=1e-6)


def test_areas_by_hand():
    box = np.array([[1.0, 2, 4, 10], [0, 0, 2, 3]])
    assert box_area(box).tolist() == [24, 6]
    assert intersection_area(box, np.array([3.0, 1, 9, 5])).tolist() == [3, 0]


def test_boxes_that_touch_or_have_no_area_share_nothing():
    box = np.array([[0, 0, 1, 1], [1, 0, 2, 1], [0, 1, 1, 2], [5, 5, 5, 5]], np.float32)
    np.testing.assert_array_equal(iou_matrix(box, box), np.diag([1, 1, 1, 0]))
    assert iou_matrix(box[:0], box).shape == (0, 4)


coordinate = st.floats(0, 100, allow_nan=False)


@given(st.lists(st.tuples(coordinate, coordinate, coordinate, coordinate), min_size=1, max_size=5))
def test_overlap_is_a_share_and_one_with_itself(corners):
    boxes = np.asarray(
        [[min(a, c), min(b, d), max(a, c) + 1, max(b, d) + 1] for a, b, c, d in corners]
    )
    table = iou_matrix(boxes, boxes)
    assert (table >= 0).all()
    assert (table <= 1 + 1e-9).all()
    np.testing.assert_allclose(np.diag(table), 1.0)
    np.testing.assert_allclose(table, table.T)
