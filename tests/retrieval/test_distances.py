"""Distances against scikit-learn, SciPy and closed forms; gradients against finite differences."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.distance import cdist
from sklearn.metrics.pairwise import additive_chi2_kernel
from torch import Tensor
from torch.autograd import grad
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from conftest import torch_threads
from igps.retrieval import chi_square, cosine, distances, euclidean

ALL = [chi_square, euclidean, cosine]
ORACLES = {
    chi_square: lambda a, b: -additive_chi2_kernel(a, b) / 2,
    euclidean: cdist,
    cosine: lambda a, b: cdist(a, b, "cosine"),
}


@pytest.fixture(params=["loops", "tiles"])
def either_device(request, monkeypatch):
    """The distances of the processor's memory, by compiled loops, and those of a device, by PyTorch's tiles."""
    monkeypatch.setattr(
        distances,
        "_uses_loops",
        lambda a, b: request.param == "loops",
    )


def histograms(n, cells, *, seed, filled=0.6):
    """Random float64 histograms that sum to 1, a share of their cells empty."""
    generator = torch.Generator().manual_seed(seed)
    values = torch.rand(
        n,
        *cells,
        generator=generator,
        dtype=torch.float64,
    )
    values *= torch.rand(n, *cells, generator=generator) < filled
    return values / values.flatten(1).sum(1).view(n, *[1] * len(cells))


@pytest.mark.usefixtures("either_device")
@pytest.mark.parametrize("distance", ALL)
@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    [
        (torch.float64, 1e-12),
        (torch.float32, 4e-6),
    ],
)
@pytest.mark.parametrize(
    ("n_queries", "n_gallery", "cells"),
    [
        (7, 5, (3, 8)),
        (1, 90, (10, 64)),
        (3, 2, (9000,)),
    ],
)
def test_agrees_with_another_library(distance, dtype, tolerance, n_queries, n_gallery, cells):
    queries = histograms(n_queries, cells, seed=1)
    gallery = histograms(n_gallery, cells, seed=2)
    expected = ORACLES[distance](
        queries.flatten(1).numpy(),
        gallery.flatten(1).numpy(),
    )
    result = distance(
        queries.to(dtype),
        gallery.to(dtype),
    )
    assert result.shape == (n_queries, n_gallery)
    assert result.dtype == dtype
    assert_allclose(result.double().numpy(), expected, rtol=0, atol=tolerance)


@pytest.mark.usefixtures("either_device")
@pytest.mark.parametrize("distance", ALL)
def test_a_set_with_itself_has_a_zero_diagonal_and_is_symmetric(distance):
    shapes = histograms(60, (10, 64), seed=3).float()
    distances = distance(shapes, shapes.clone())
    assert torch.equal(
        distances.diagonal(),
        torch.zeros(60),
    )
    assert torch.equal(distances, distances.T)
    assert (distances >= 0).all()


def test_near_vectors_keep_their_cosine_distance():
    angle = 1e-3
    a = torch.tensor([[1.0, 0.0]])
    b = torch.tensor(
        [[np.cos(angle), np.sin(angle)]],
        dtype=torch.float32,
    )
    # 1 − cos in float32 would be 6 % off
    assert cosine(a, b).item() == pytest.approx(angle**2 / 2, rel=1e-4)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_cosine_ignores_length_even_at_the_ends_of_the_dtype(scale):
    a = torch.tensor([[1.0, 1.0]])
    b = torch.tensor([[1.0, 0.0]])
    assert cosine(scale * a, scale * b).item() == pytest.approx(1 - 0.5**0.5, rel=1e-6)


@pytest.mark.parametrize("distance", ALL)
def test_threads_change_no_bit(distance, many_cores, monkeypatch):
    monkeypatch.setattr(distances, "_TRIPLES_PER_THREAD", 0)
    queries = histograms(70, (40,), seed=21)
    gallery = histograms(9, (40,), seed=22)
    found = []
    for n_threads in (1, 2, 3):
        with torch_threads(n_threads):
            found.append(distance(queries, gallery))
    assert torch.equal(found[1], found[0])
    assert torch.equal(found[2], found[0])
    expected = ORACLES[distance](
        queries.numpy(),
        gallery.numpy(),
    )
    assert_allclose(
        found[0].numpy(),
        expected,
        rtol=0,
        atol=1e-12,
    )


@pytest.mark.usefixtures("either_device")
def test_chi_square_of_tiny_entries_does_not_underflow():
    found = chi_square(torch.tensor([[1e-30]]), torch.tensor([[0.0]])).item()
    assert found == pytest.approx(5e-31, rel=1e-6, abs=0)


def test_half_precision_is_computed_in_float32():
    queries = histograms(4, (5, 8), seed=4).half()
    for distance in ALL:
        expected = distance(
            queries.float(),
            queries[:2].float(),
        )
        assert_close(distance(queries, queries[:2]), expected)


@pytest.mark.usefixtures("either_device")
def test_cells_that_are_multiplied_in_both_weigh_so_much_in_chi_square():
    queries = histograms(4, (3, 8), seed=5)
    gallery = histograms(6, (3, 8), seed=6)
    for shape in [(3, 8), (3, 1), (8,), ()]:
        weights = 2 * torch.rand(
            shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64
        )
        expected = np.zeros((4, 6))
        for q, g, i, j in np.ndindex(4, 6, 3, 8):
            a = float(queries[q, i, j])
            b = float(gallery[g, i, j])
            if a + b > 0:
                weight = float(weights.broadcast_to(3, 8)[i, j])
                expected[q, g] += 0.5 * weight * (a - b) ** 2 / (a + b)
        found = chi_square(weights * queries, weights * gallery)
        assert_allclose(found.numpy(), expected, atol=1e-14)


@pytest.mark.parametrize("distance", ALL)
def test_gradients_agree_with_finite_differences(distance):
    queries = histograms(3, (2, 5), seed=8, filled=2)
    gallery = histograms(4, (2, 5), seed=9, filled=2)
    queries = (10 * queries + 0.1).requires_grad_()
    gallery = (10 * gallery + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(distance, (queries, gallery))


def test_chi_square_gradients_over_several_tiles_agree_with_autograd_on_the_formula():
    queries = histograms(40, (9000,), seed=10, filled=2)
    gallery = histograms(30, (9000,), seed=11, filled=2)
    upstream = torch.rand(
        40,
        30,
        generator=torch.Generator().manual_seed(13),
        dtype=torch.float64,
    )
    arguments = [tensor.requires_grad_() for tensor in (queries, gallery)]
    gradients = grad(
        (chi_square(*arguments) * upstream).sum(),
        arguments,
    )
    a = queries[:, None]
    b = gallery[None]
    plain = ((a - b) ** 2 / (a + b)).sum(-1) / 2
    for ours, expected in zip(
        gradients,
        grad((plain * upstream).sum(), arguments),
        strict=True,
    ):
        assert_close(ours, expected, rtol=1e-9, atol=1e-12)


def test_chi_square_has_second_derivatives_and_none_at_empty_cells():
    queries = histograms(3, (6,), seed=27, filled=2)
    gallery = histograms(4, (6,), seed=28, filled=2)
    leaves = [one.requires_grad_() for one in (queries, gallery)]
    assert torch.autograd.gradgradcheck(chi_square, leaves)
    empty = torch.zeros(
        1,
        2,
        dtype=torch.float64,
        requires_grad=True,
    )
    [first] = grad(
        chi_square(empty, torch.zeros(1, 2).double()).sum(),
        empty,
        create_graph=True,
    )
    assert grad(first.sum(), empty)[0].tolist() == [[0, 0]]


@pytest.mark.parametrize("distance", ALL)
def test_gradients_are_finite_at_empty_cells_and_at_distance_zero(distance):
    shapes = histograms(6, (3, 8), seed=16, filled=0.3).requires_grad_()
    empty = (shapes.detach() == 0).all(0)
    assert empty.any()  # a cell that is empty in every shape
    distance(shapes, shapes).sum().backward()
    assert shapes.grad is not None
    assert torch.isfinite(shapes.grad).all()
    assert torch.equal(
        shapes.grad[:, empty],
        torch.zeros(
            6,
            int(empty.sum()),
            dtype=torch.float64,
        ),
    )


def test_chi_square_never_holds_all_triples_of_query_gallery_and_cell():
    class LargestBlock(TorchDispatchMode):
        n_bytes = 0

        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            result = func(*args, **(kwargs or {}))
            if isinstance(result, Tensor) and result.ndim == 3:  # (queries, gallery, cells)
                self.n_bytes = max(self.n_bytes, result.nbytes)
            return result

    for n_shapes, n_cells in [(100, 4096), (2, 500_000)]:  # all triples would be 164 MB and 8 MB
        shapes = histograms(n_shapes, (n_cells,), seed=17).float().requires_grad_()
        with LargestBlock() as largest:
            chi_square(shapes, shapes).sum().backward()
        assert 0 < largest.n_bytes <= 2**20


@pytest.mark.usefixtures("either_device")
@pytest.mark.parametrize("distance", ALL)
def test_an_empty_set_of_queries_gives_an_empty_matrix(distance):
    assert distance(torch.empty(0, 4), torch.ones(3, 4)).shape == (0, 3)


@pytest.mark.parametrize(
    ("queries", "gallery", "message"),
    [
        (torch.ones(2, 3), torch.ones(2, 4), "gallery: expected descriptors of the shape"),
        (torch.ones(3), torch.ones(2, 3), "queries: expected shape"),
        (torch.ones(2, 3), np.ones((2, 3)), "gallery: expected a tensor, got ndarray"),
        (torch.ones(2, 3), torch.ones(2, 0), "gallery: expected shape"),
        (
            torch.ones(2, 3, dtype=torch.int64),
            torch.ones(2, 3),
            "queries: expected a real floating dtype",
        ),
        (
            torch.ones(2, 3),
            torch.tensor([[1.0, float("nan"), 1.0]]),
            "gallery: expected finite entries",
        ),
    ],
)
def test_wrong_descriptors_are_refused(queries, gallery, message):
    for distance in ALL:
        with pytest.raises(ValueError, match=message):
            distance(queries, gallery)


def test_chi_square_refuses_negative_entries():
    with pytest.raises(ValueError, match="gallery: expected entries ≥ 0"):
        chi_square(
            torch.ones(2, 3),
            torch.tensor([[0.5, -0.1, 0.6]]),
        )


def test_cosine_refuses_a_descriptor_without_direction():
    with pytest.raises(
        ValueError, match="queries: expected descriptors of non-zero length, 1 of 2"
    ):
        cosine(
            torch.tensor([[0.0, 0.0], [1.0, 0.0]]),
            torch.ones(1, 2),
        )
