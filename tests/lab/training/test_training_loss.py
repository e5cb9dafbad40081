"""Which cells answer for whom, and what a wrong answer costs."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'bikeped[train]'")

from bikeped.lab.training.loss import (  # noqa: E402
    ImageLabels,
    assign,
    detection_loss,
    generalised_iou,
    pairwise_iou,
)
from bikeped.lab.training.network import grid  # noqa: E402

CENTRE, STRIDE = grid(160, 96)
NONE = torch.zeros(0, 4)


def truth(*boxes, classes=None, ignored=NONE):
    ids = torch.tensor(classes or [0] * len(boxes))
    return ImageLabels(torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4), ids, ignored)


def perfect(what, sure=8.0):
    """Scores and edges [1, ., cells] of a network that knows `what`."""
    box = torch.zeros(len(CENTRE), 4)
    box[:, :2], box[:, 2:] = CENTRE - 4, CENTRE + 4
    score = torch.full((1, 3, len(CENTRE)), -sure)
    for one, kind in zip(what.box_px, what.class_id, strict=True):
        inside = ((one[:2] < CENTRE) & (one[2:] > CENTRE)).all(1)
        box[inside] = one
        score[0, kind, inside] = sure
    low, high = (CENTRE - box[:, :2]) / STRIDE[:, None], (box[:, 2:] - CENTRE) / STRIDE[:, None]
    return score, torch.cat([low, high], 1).T[None]


def loss_of(score, edge, what):
    return detection_loss(score, edge, [what], CENTRE, STRIDE)


def test_overlaps():
    a = torch.tensor([[0.0, 0, 10, 10], [20, 20, 30, 30]])
    b = torch.tensor([[5.0, 0, 15, 10], [20, 20, 30, 30]])
    assert pairwise_iou(a, b)[0, 0].item() == pytest.approx(1 / 3)
    assert pairwise_iou(a, b)[0, 1].item() == 0
    same = generalised_iou(a, b)
    assert same[1].item() == pytest.approx(1)
    assert same[0].item() == pytest.approx(1 / 3)  # the hull is the union
    far = generalised_iou(torch.tensor([[0.0, 0, 1, 1]]), torch.tensor([[9.0, 0, 10, 1]]))
    assert far.item() == pytest.approx(-0.8)


def test_the_right_answer_costs_little_and_each_kind_of_error_more():
    what = truth([40, 20, 72, 76], classes=[1])
    score, edge = perfect(what)
    good, parts = loss_of(score, edge, what)
    assert set(parts) == {"score", "overlap", "edge"}
    assert parts["overlap"] == pytest.approx(0, abs=1e-3)
    assert parts["edge"] == pytest.approx(0, abs=1e-3)
    moved, _ = loss_of(score, edge + 0.5, what)
    other = truth([40, 20, 72, 76], classes=[2])
    wrong_kind, _ = loss_of(score, edge, other)
    assert moved > good + 0.3
    assert wrong_kind > good + 0.3


def test_the_lower_edge_counts_most():
    what = truth([40, 20, 72, 76])
    score, edge = perfect(what)
    shifts = []
    for side in range(4):
        worse = edge.clone()
        worse[:, side] += 0.3
        shifts.append(loss_of(score, worse, what)[1]["edge"])
    assert max(shifts[:3]) < shifts[3]


def test_an_empty_picture_asks_for_silence():
    nobody = truth()
    score, edge = perfect(nobody)
    quiet, parts = loss_of(score, edge, nobody)
    assert set(parts) == {"score"}
    score[0, 0, 5] = 4
    loud, _ = loss_of(score, edge, nobody)
    assert loud > quiet + 1


def test_an_ignored_box_forgives_whatever_is_said_in_it():
    hidden = torch.tensor([[40.0, 20, 72, 76]])
    loud, edge = perfect(truth([40, 20, 72, 76]))
    judged, _ = loss_of(loud, edge, truth())
    forgiven, _ = loss_of(loud, edge, truth(ignored=hidden))
    assert judged > 10
    assert forgiven < 0.5


def test_an_object_in_an_ignored_box_is_still_asked_for():
    crowd = torch.tensor([[0.0, 0, 160, 96]])
    what = truth([40, 20, 72, 76], ignored=crowd)
    score, edge = perfect(what)
    silent = torch.full_like(score, -8.0)
    assert loss_of(silent, edge, what)[0] > loss_of(score, edge, what)[0] + 1


def test_every_object_has_a_cell_even_a_tiny_one_between_cells():
    # 3 x 5 pixels around the corner of four cells: no centre lies in it.
    what = truth([30.5, 30, 33.5, 35], [100, 60, 103, 64])
    _, edge = perfect(truth())
    from bikeped.lab.training.network import boxes_px

    given = assign(
        torch.full((3, len(CENTRE)), 0.01), boxes_px(edge, CENTRE, STRIDE)[0], what, CENTRE
    )
    owners = given.target[given.chosen]
    assert set(owners.tolist()) == {0, 1}
    assert (given.quality[~given.chosen] == 0).all()
    reach = (CENTRE[given.chosen] - torch.tensor([[32, 32.5], [101.5, 62]])[owners]).abs()
    assert float(reach.max()) <= 8


def test_a_cell_that_two_want_answers_for_the_nearer_fit():
    what = truth([40, 40, 56, 64], [42, 40, 58, 64], classes=[0, 1])
    box = torch.tensor([42.0, 40, 58, 64]).expand(len(CENTRE), 4)
    given = assign(torch.full((3, len(CENTRE)), 0.5), box, what, CENTRE)
    # All cells box the second one exactly; where both reach, it wins.
    both = ((torch.tensor([42.0, 40]) < CENTRE) & (torch.tensor([56.0, 64]) > CENTRE)).all(1)
    assert set(given.target[given.chosen & both].tolist()) == {1}
    assert given.quality.max().item() == pytest.approx(1, abs=1e-3)


def test_a_network_that_overlaps_nothing_yet_is_still_given_cells():
    what = truth([40, 20, 72, 76])
    box = torch.zeros(len(CENTRE), 4)  # no area at all
    given = assign(torch.full((3, len(CENTRE)), 0.01), box, what, CENTRE)
    assert 0 < int(given.chosen.sum()) <= 10
    middle = torch.tensor([56.0, 48.0])
    assert float((CENTRE[given.chosen] - middle).abs().max()) <= 28


def test_gradients_are_finite_when_boxes_have_no_area():
    what = truth([40, 20, 72, 76])
    score = torch.zeros(1, 3, len(CENTRE), requires_grad=True)
    edge = torch.zeros(1, 4, len(CENTRE), requires_grad=True)
    loss, _ = loss_of(score, edge, what)
    loss.backward()
    assert torch.isfinite(score.grad).all()
    assert torch.isfinite(edge.grad).all()
