"""The compiled way to histograms of pairs, beside what the tests of the histograms themselves ask of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from conftest import torch_threads
from igps import _threads as threads
from igps._compiled import is_available
from igps.nn._kernels import counted_pairs
from igps.nn._kernels.counted_pairs import can_count, count_pairs
from loops import Axis, cosines, distances, pair_histogram_by_loops

pytestmark = pytest.mark.skipif(not is_available(), reason="needs numba, the extra [fast]")

FEW = [0.3, 0.5, 0.52, 1.9]
EQUAL = [0.25, 0.75, 1.25, 1.75, 2.25]
# Beyond the first few the intervals are looked up, and several of these are in one step of the table.
MANY = [0.1, 0.4, 0.401, 0.4012, 0.4013, 0.7, 0.9, 1.0, 1.1, 1.15, 1.3, 1.5, 1.6, 1.9, 2.2, 2.9]
COSINES = [-0.7, 0.1, 0.6]


def points_and_more(n_points: int = 23) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Coordinates, points, directions, and memberships in three classes, of which many are 0."""
    generator = torch.Generator().manual_seed(4)

    def normal(width: int) -> Tensor:
        return torch.randn(n_points, width, generator=generator, dtype=torch.float64)

    memberships = torch.rand(n_points, 3, generator=generator, dtype=torch.float64)
    memberships[::2] = (memberships[::2] > 0.6).double()
    memberships[memberships.sum(dim=1) == 0, 1] = 1
    return normal(5) * 0.5, normal(3) * 0.4, normalize(normal(3), dim=1), normalize(memberships, p=1, dim=1)


@pytest.mark.parametrize("rows_and_columns", [None, (1, 4), (5, 6)])
@pytest.mark.parametrize("layouts", [[EQUAL], [MANY], [FEW, MANY], [FEW, EQUAL, MANY]])
@pytest.mark.parametrize("n_oriented", [0, 1])
def test_histogram_is_the_sum_of_hats_over_all_pairs(
    rows_and_columns: tuple[int, int] | None,
    layouts: list[list[float]],
    n_oriented: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    coordinates, points, directions, memberships = points_and_more()
    places = [coordinates, points, directions][: len(layouts)]
    if rows_and_columns is not None:
        n_rows, n_columns = rows_and_columns
        monkeypatch.setattr(counted_pairs, "_MOST_COLUMNS", n_columns)
        monkeypatch.setattr(counted_pairs, "_BLOCK", n_rows * n_columns * len(layouts))
    chosen = [(place, torch.tensor(layout).double()) for place, layout in zip(places, layouts, strict=True)]
    angles = torch.tensor(COSINES).double()
    result = count_pairs(memberships, chosen, [(points, directions, angles, angles)] * n_oriented)
    axes: list[Axis] = [(distances(place), centres.tolist()) for place, centres in chosen]
    axes += [(value, angles.tolist()) for value in cosines(points, directions)] * n_oriented
    np.testing.assert_allclose(result, pair_histogram_by_loops(memberships, axes), atol=1e-12)


def test_single_precision_is_summed_in_double() -> None:
    """Half a million pairs whose weights are not whole: in single precision the sum would be off by some 10⁻⁴."""
    coordinates, _, _, memberships = (tensor.float() for tensor in points_and_more(1000))
    result = count_pairs(memberships, [(coordinates, torch.tensor(MANY))])
    assert result.dtype == torch.float64
    assert result.sum() == pytest.approx(1, abs=1e-7)
    expected = count_pairs(memberships.double(), [(coordinates.double(), torch.tensor(MANY).double())])
    np.testing.assert_allclose(result, expected, atol=1e-7)


def test_oriented_points_of_several_numbers_of_dimensions_side_by_side() -> None:
    """Points on a line, in space and in five dimensions: a single histogram with and one without its distances."""
    generator = torch.Generator().manual_seed(8)
    memberships, angles = torch.ones(11, 1).double(), torch.tensor([-0.6, 0.5]).double()
    places = [torch.randn(11, width, generator=generator, dtype=torch.float64) for width in (1, 3, 5)]
    ways = [normalize(torch.randn(11, p.shape[1], generator=generator, dtype=torch.float64), dim=1) for p in places]
    chosen = [(places[2], torch.tensor(FEW).double())]
    for axes in ([], chosen):
        expected: list[Axis] = [(distances(place), centres.tolist()) for place, centres in axes]
        for p, n in zip(places, ways, strict=True):
            expected += [(value, angles.tolist()) for value in cosines(p, n)]
        result = count_pairs(memberships, axes, [(p, n, angles, angles) for p, n in zip(places, ways, strict=True)])
        np.testing.assert_allclose(result, pair_histogram_by_loops(memberships, expected), atol=1e-12)


@pytest.mark.parametrize("centres", [EQUAL, MANY])
def test_whole_pairs_of_single_precision_are_as_those_of_double(centres: list[float]) -> None:
    """Points in one class each are counted in integers, several classes, and many alike side by side."""
    generator = torch.Generator().manual_seed(6)
    points = torch.randn(2300, 3, generator=generator).sort(dim=0).values * 0.4
    memberships = torch.nn.functional.one_hot(torch.randint(3, (2300,), generator=generator), 3).double()
    result = count_pairs(memberships, [(points, torch.tensor(centres))])
    expected = count_pairs(memberships, [(points.double(), torch.tensor(centres))])
    np.testing.assert_allclose(result, expected, atol=1e-8)


@pytest.mark.parametrize(("spread", "bin_of_all"), [(0.0, 0), (1e4, 4)])
def test_a_block_of_pairs_that_all_fall_into_one_bin(spread: float, bin_of_all: int) -> None:
    """As many as are ever counted at once in one integer, with the largest share and with none."""
    points = torch.arange(1.0, 2401.0)[:, None] * spread
    expected = torch.zeros(1, 5, dtype=torch.float64)
    expected[0, bin_of_all] = 1
    assert torch.equal(count_pairs(torch.ones(2400, 1), [(points, torch.tensor(EQUAL))]), expected)


def test_serves_what_needs_no_gradient_on_the_cpu() -> None:
    points = torch.zeros(3, 2)
    learned = torch.zeros(2, requires_grad=True)
    assert can_count(points)
    assert not can_count(points, learned)
    assert not can_count(points.half())
    assert not can_count(torch.zeros(3, 2, device="meta"))
    with torch.no_grad():
        assert can_count(points, learned)


def test_a_single_centre_is_refused() -> None:
    with pytest.raises(ValueError, match=r"centres: expected at least two along each dimension, got \[1\]"):
        count_pairs(torch.ones(2, 1), [(torch.rand(2, 1), torch.ones(1))])


def test_distances_that_cannot_be_told_are_refused() -> None:
    one_class = torch.ones(2, 1)
    far = torch.tensor([[-1e19, 0.0], [1e19, 0.0]])
    with pytest.raises(ValueError, match="points: expected distances that can be squared"):
        count_pairs(one_class, [(far, torch.tensor([0.5, 1.0]))])
    assert count_pairs(one_class, [(far / 10, torch.tensor([0.5, 1.0]))]).tolist() == [[0, 1]]


def test_threads_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """700 points, several blocks for each share."""
    monkeypatch.setattr(threads, "n_cores", lambda: 8)
    coordinates, points, directions, memberships = points_and_more(700)
    centres, angles = torch.tensor(MANY).double(), torch.tensor(COSINES).double()
    histograms = []
    for n_threads in (1, 2, 5):
        with torch_threads(n_threads):
            histograms.append(
                count_pairs(memberships, [(coordinates, centres)], [(points, directions, angles, angles)])
            )
    torch.testing.assert_close(histograms[0].sum(), torch.ones((), dtype=torch.float64))
    assert torch.equal(histograms[0], histograms[1])
    assert torch.equal(histograms[0], histograms[2])
