import numpy as np
import pytest

from bikeped.geometry.boxes import intersection_area
from bikeped.overlay.drawing import (
    INK,
    KIND_COLOUR,
    PAPER,
    fill_rect,
    fit_text,
    place_label,
    polyline,
    readable_on,
    text_size,
    wrap_text,
)

BOUNDS = (0.0, 0.0, 400.0, 300.0)


def test_label_goes_above_its_box_when_there_is_room():
    x0, y0, x1, y1 = place_label((60, 16), (100, 100, 150, 200), [], BOUNDS)
    assert (x0, y1) == (100, 98)
    assert (x1 - x0, y1 - y0) == (60, 16)


@pytest.mark.parametrize("box", [(0, 0, 40, 50), (370, 0, 400, 60), (350, 280, 400, 300)])
def test_label_stays_inside_the_picture(box):
    x0, y0, x1, y1 = place_label((90, 18), box, [], BOUNDS)
    assert x0 >= 0
    assert y0 >= 0
    assert x1 <= 400
    assert y1 <= 300


def test_labels_of_a_crowd_do_not_cover_one_another():
    taken = []
    for i in range(5):
        box = (180 + 4 * i, 140 + 2 * i, 200 + 4 * i, 190 + 2 * i)
        spot = place_label((80, 16), box, taken, BOUNDS)
        assert all(intersection_area(np.array(spot), np.array(other)) == 0 for other in taken)
        taken.append(spot)


def test_text_fits_the_width_that_it_is_given():
    text = "Cyclist 12 and pedestrian 7 are 10.90 m apart and closing"
    cut = fit_text(text, 12, 150)
    assert cut.endswith("...")
    assert text_size(cut, 12)[0] <= 150
    lines = wrap_text(text, 12, 200, 2)
    assert len(lines) == 2
    assert all(text_size(line, 12)[0] <= 200 for line in lines)
    assert wrap_text("short", 12, 200, 2) == ["short"]


def test_text_keeps_its_contrast_on_every_colour():
    assert readable_on((240, 160, 0)) == INK
    assert readable_on((0, 100, 170)) == PAPER
    assert len(set(KIND_COLOUR.values())) == 3


def test_broken_lines_are_broken_where_a_point_is_unseen():
    image = np.zeros((20, 60, 3), np.uint8)
    points = np.array([[2.0, 10], [20, 10], [np.nan, np.nan], [40, 10], [58, 10]])
    polyline(image, points, (255, 255, 255), 1)
    assert image[10, 10].all()
    assert image[10, 50].all()
    assert not image[:, 24:37].any()


def test_fill_is_clipped_to_the_picture():
    image = np.zeros((10, 10, 3), np.uint8)
    fill_rect(image, (-5, -5, 3, 3), (9, 9, 9))
    fill_rect(image, (20, 20, 30, 30), (9, 9, 9), 0.5)
    assert int((image == 9).all(-1).sum()) == 9
