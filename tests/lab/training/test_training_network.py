"""The small network: shapes, its grid, and the layout in which it answers."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'bikeped[train]'")

from bikeped.detection.model_metadata import ModelMetadata  # noqa: E402
from bikeped.detection.output_layouts import anchor_count, choose_layout, decode  # noqa: E402
from bikeped.lab.training.network import (  # noqa: E402
    STRIDES,
    ExportModule,
    SmallNet,
    boxes_px,
    grid,
    multiply_adds,
    shift_scores,
)

SIZE = (96, 64)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return SmallNet(3).eval()


def test_every_cell_answers(network):
    with torch.no_grad():
        score, edge = network(torch.zeros(2, 3, 64, 96))
    cells = anchor_count(SIZE, STRIDES)
    assert score.shape == (2, 3, cells)
    assert edge.shape == (2, 4, cells)


def test_it_fits_the_package_and_two_cores(network):
    weights = sum(p.numel() for p in network.parameters())
    assert weights * 4 < 4e6  # bytes
    assert multiply_adds(network, 960, 544) < 2e9


def test_counting_leaves_the_network_as_it_was(network):
    trained = SmallNet(1).train()
    before = trained.stem[0].norm.running_mean.clone()
    assert multiply_adds(trained, 96, 64) > 1e6
    assert trained.training
    assert torch.equal(before, trained.stem[0].norm.running_mean)


def test_cells_lie_row_by_row_stride_by_stride():
    centre, stride = grid(*SIZE)
    assert centre[0].tolist() == [4, 4]
    assert centre[1].tolist() == [12, 4]
    assert centre[12].tolist() == [4, 12]
    assert stride[95] == 8
    assert centre[96].tolist() == [8, 8]
    assert centre[-1].tolist() == [80, 48]
    assert stride[-1] == 32


def test_edges_are_strides_from_the_cells_own_centre():
    centre, stride = grid(*SIZE)
    edge = torch.tensor([1.0, 2.0, 3.0, 4.0]).reshape(1, 4, 1).expand(1, 4, len(centre))
    box = boxes_px(edge, centre, stride)
    assert box[0, 0].tolist() == [4 - 8, 4 - 16, 4 + 24, 4 + 32]
    assert box[0, -1].tolist() == [80 - 32, 48 - 64, 80 + 96, 48 + 128]


def test_the_answer_is_what_the_detector_reads_as_yolov8(network):
    with torch.no_grad():
        picture = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(1))
        answer = ExportModule(network).eval()(picture).numpy()
        score, edge = network(picture)
    facts = ModelMetadata(names=("pedestrian", "cyclist", "vehicle"), ultralytics=True)
    assert choose_layout(answer, SIZE, facts, "auto", "test").layout == "yolov8"
    found = decode(answer, "yolov8", SIZE, 1e-6, np.ones(3, bool), "test")
    expected = boxes_px(edge, *grid(*SIZE))[0].numpy()
    solid = (expected[:, 2:] > expected[:, :2]).all(axis=1)
    np.testing.assert_allclose(found.box, expected[solid], atol=1e-3)
    best = score[0].sigmoid().max(0).values.numpy()
    np.testing.assert_allclose(found.score, best[solid], atol=1e-5)


def test_before_it_has_learnt_it_sees_nobody(network):
    with torch.no_grad():
        score, _ = network(torch.zeros(1, 3, 64, 96))
    assert float(score.sigmoid().max()) < 0.1


def test_scores_move_class_by_class_and_keep_their_order():
    torch.manual_seed(1)
    moved = SmallNet(3).eval()
    picture = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        before = moved(picture)[0].sigmoid()
        shift_scores(moved, [0.4, 0.5, 0.1], 0.1)
        after = moved(picture)[0].sigmoid()
    odds = (after / (1 - after)) / (before / (1 - before))
    expected = torch.tensor([(0.1 / 0.9) / (0.4 / 0.6), (0.1 / 0.9), 1.0])
    torch.testing.assert_close(odds.mean(2)[0], expected, rtol=1e-3, atol=1e-4)
