"""Histograms of branches and of pieces, against loops over components, and on bodies whose limbs are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree
from torch.testing import assert_close

from batches import batch_of, embedded, two_bodies
from igps.data.requirements import Requirements
from igps.descriptors.pretrained.branch_histogram import BranchHistogram
from igps.descriptors.pretrained.piece_histogram import PieceHistogram
from igps.nn.batch_features import N_NEIGHBOURS
from igps.nn.embedding import SpectralEmbedding
from loops import hat

EMBEDDING = SpectralEmbedding(n_eigenpairs=5)
LEVELS = (0.1, 0.3, 0.6)

BOTH = pytest.mark.parametrize("make", [BranchHistogram, PieceHistogram])


def joined(coordinates):
    """Of each point those that it is joined to: the nearest, and those to which it is near."""
    found = [set() for _ in coordinates]
    _, nearest = cKDTree(coordinates).query(coordinates, N_NEIGHBOURS + 1)
    for i, row in enumerate(nearest.tolist()):
        for j in row[1:]:
            found[i].add(j)
            found[j].add(i)
    return found


def pieces_of(kept, graph):
    left = set(kept)
    found = []
    while left:
        piece = set()
        front = {left.pop()}
        while front:
            piece |= front
            front = {k for point in front for k in graph[point]} & left
            left -= front
        found.append(piece)
    return found


def test_branches_are_as_long_as_pieces_stay_apart():
    """By brute force: components of every superlevel set; when components merge, that of the highest peak survives."""
    batch = two_bodies()
    found = BranchHistogram(EMBEDDING, n_branches=4)(batch)
    for i in range(2):
        coordinates = embedded(batch, i, "surface", 5).numpy()
        heights = np.log(np.linalg.norm(coordinates, axis=1))
        graph = joined(coordinates)
        living = {}
        lengths = []
        order = np.argsort(-heights).tolist()
        for n, point in enumerate(order):
            pieces = pieces_of(set(order[: n + 1]), graph)
            peaks = {max(piece, key=lambda k: heights[k]) for piece in pieces}
            ended = [height for peak, height in living.items() if peak not in peaks]
            lengths += [height - heights[point] for height in ended]
            living = {peak: heights[peak] for peak in peaks}
        lengths += [height - heights.min() for height in living.values()]
        expected = np.sort(lengths)[::-1][:4]
        expected = np.pad(expected, (0, 4 - len(expected)))
        assert_allclose(found[i], expected / expected.sum(), atol=1e-5)


def test_pieces_count_by_their_sizes_and_lengths():
    """One level, piece and cell at a time."""
    batch = two_bodies()
    found = PieceHistogram(LEVELS, EMBEDDING, n_bins=(4, 3))(batch)
    assert found.shape == (2, 3, 4, 3)
    sizes = np.linspace(-6, -0.5, 4).tolist()
    lengths = np.linspace(-1, 2.5, 3).tolist()
    for i in range(2):
        points = batch.surface.points[i, batch.surface.mask[i]].numpy()
        points = points / np.sqrt(float(batch.area[i]))
        coordinates = embedded(batch, i, "surface", 5).numpy()
        graph = joined(coordinates)
        order = np.argsort(-np.linalg.norm(coordinates, axis=1)).tolist()
        expected = np.zeros((3, 4, 3))
        for level, share in enumerate(LEVELS):
            for piece in pieces_of(
                set(order[: round(share * len(order))]),
                graph,
            ):
                size = len(piece) / len(order)
                places = points[sorted(piece)]
                length = 2.0**-9
                if len(piece) >= 4:
                    largest = np.linalg.eigvalsh(np.cov(places.T, ddof=0))[-1]
                    length = float(np.sqrt(12 * largest / size))
                row = hat(float(np.log2(size)), sizes)
                column = hat(float(np.log2(length)), lengths)
                expected[level] += len(piece) * np.outer(row, column)
        assert_allclose(found[i], expected / expected.sum(), atol=1e-5)


def star(n_arms, length, seed):
    """Arms that start at 1 from the origin and reach to exp(length), in an embedding of as many dimensions."""
    generator = torch.Generator().manual_seed(seed)
    along = torch.linspace(0, length, 60).exp()
    arms = (torch.eye(n_arms)[:, None] * along[:, None]).flatten(0, 1)
    middle = torch.nn.functional.normalize(
        torch.rand(200, n_arms, generator=generator),
        dim=1,
    )
    points = torch.cat([arms, 0.999 * middle])
    noise = 1e-4 * torch.rand(points.shape, generator=generator)
    return batch_of(
        (points + noise)[None],
        points=points[None, :, :3].contiguous(),
    )


def test_as_many_shares_are_large_as_there_are_arms():
    found = BranchHistogram(SpectralEmbedding())(star(5, 1.0, seed=5))[0]
    assert (found[:5] > 0.8 / 5).all()
    assert float(found[5:].sum()) < 0.1


def test_pieces_of_a_star_are_its_arms():
    """Each of three arms has 60 of 380 points: the binary log is −2.66, between the last two centres."""
    histogram = PieceHistogram(
        (180 / 380,),
        SpectralEmbedding(),
        n_bins=(6, 5),
    )
    found = histogram(star(3, 1.0, seed=3))[0, 0]
    of_sizes = np.array(
        hat(
            float(np.log2(60 / 380)),
            np.linspace(-6, -0.5, 6).tolist(),
        )
    )
    assert_allclose(found.sum(dim=1), of_sizes, atol=0.02)
    assert float(found[:, 3:].sum()) > 0.9  # rods


@BOTH
def test_a_subset_of_the_samples_is_told(make):
    batch = two_bodies()
    expected = make(embedding=EMBEDDING)(
        replace(
            batch,
            surface=batch.surface.subset(20, seed=0),
        )
    )
    assert_close(make(embedding=EMBEDDING, n_samples=20)(batch), expected)
    interior = make(embedding=EMBEDDING, samples="interior")(batch)
    assert_close(interior, make(embedding=EMBEDDING)(replace(batch, surface=batch.interior)))


@BOTH
def test_a_body_that_is_the_same_everywhere_is_one_piece(make):
    same = batch_of(
        torch.ones(1, 10, 3),
        points=torch.ones(1, 10, 3),
    )
    found = make()(same)
    assert_close(found.sum(), torch.tensor(1.0))
    assert torch.isfinite(found).all()
    if make is BranchHistogram:
        assert found[0, 0] == 1


@BOTH
def test_needs_and_what_is_refused(make):
    assert make(embedding=EMBEDDING).requirements == Requirements(n_eigenpairs=5)
    with pytest.raises(ValueError, match="n_samples: expected at least 2, got 1"):
        make(n_samples=1)
    batch = two_bodies()
    none = replace(
        batch.surface,
        mask=torch.zeros_like(batch.surface.mask),
    )
    with pytest.raises(ValueError, match="samples: expected at least one of each body, got none"):
        make(embedding=EMBEDDING)(replace(batch, surface=none))
    missing = torch.full_like(batch.surface.eigenfunctions, torch.nan)
    broken = replace(batch.surface, eigenfunctions=missing)
    with pytest.raises(ValueError, match="expected finite numbers, got NaN or infinity"):
        make(embedding=EMBEDDING)(replace(batch, surface=broken))


def test_layouts_that_are_none_are_named():
    with pytest.raises(ValueError, match="n_branches: expected at least 2, got 1"):
        BranchHistogram(n_branches=1)
    for levels in ((), (0.5, 0.2), (0.0, 0.5), (0.5, 1.5)):
        with pytest.raises(
            ValueError, match="levels: expected shares above 0 and up to 1, ascending"
        ):
            PieceHistogram(levels)
    with pytest.raises(ValueError, match="n_bins: expected two numbers, each at least 2"):
        PieceHistogram(n_bins=(1, 5))
    batch = two_bodies()
    broken = replace(
        batch.surface,
        points=torch.full_like(batch.surface.points, torch.inf),
    )
    with pytest.raises(ValueError, match="PieceHistogram: expected finite positions"):
        PieceHistogram(embedding=EMBEDDING)(replace(batch, surface=broken))


def test_gradients_are_those_of_differences():
    generator = torch.Generator().manual_seed(7)
    embedding = torch.randn(
        1,
        12,
        3,
        generator=generator,
        dtype=torch.float64,
    )
    points = torch.rand(
        1,
        12,
        3,
        generator=generator,
        dtype=torch.float64,
    )

    def branches(values):
        return BranchHistogram(SpectralEmbedding(), n_branches=3).double()(batch_of(values))

    def pieces(values):
        histogram = PieceHistogram((0.5, 0.9), SpectralEmbedding()).double()
        return histogram(batch_of(embedding, points=values))

    assert torch.autograd.gradcheck(branches, embedding.requires_grad_())
    embedding.requires_grad_(False)
    assert torch.autograd.gradcheck(pieces, points.requires_grad_())
