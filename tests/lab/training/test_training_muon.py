"""The optimiser of the convolutions: steps as long in every direction."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'bikeped[train]'")

from bikeped.lab.training.fit import Muon, orthogonal  # noqa: E402


@pytest.mark.parametrize("shape", [(16, 27), (64, 64), (96, 12)])
def test_singular_values_come_near_one_and_directions_stay(shape):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    made = orthogonal(matrix)
    assert made.shape == matrix.shape
    values = torch.linalg.svdvals(made)
    # The iteration promises 0.68 to 1.13 where values are not tiny beside the largest.
    assert values.max() < 1.25
    assert values.median() > 0.6
    u, _, v = torch.linalg.svd(matrix, full_matrices=False)
    aligned = (u.T @ made @ v.T).diagonal()
    assert (aligned > 0).all()


def test_it_goes_down_where_one_direction_is_hundreds_of_times_as_steep():
    steep = torch.logspace(-2, 0, 8)
    weight = torch.nn.Parameter(torch.eye(8))
    optimiser = Muon([weight], lr=0.05, decay=0.0)
    for _ in range(60):
        optimiser.zero_grad()
        (weight.square() * steep[:, None]).sum().backward()
        optimiser.step()
    assert weight.abs().max() < 0.5  # the flattest direction, too: plain descent leaves it at 0.94


def test_decay_pulls_to_nought_and_a_weight_without_gradient_stays():
    moved, still = (torch.nn.Parameter(torch.eye(4)) for _ in range(2))
    optimiser = Muon([moved, still], lr=0.1, decay=1.0)
    moved.grad = torch.zeros(4, 4)
    optimiser.step()
    assert torch.allclose(moved, torch.eye(4) * 0.9)
    assert torch.equal(still, torch.eye(4))
