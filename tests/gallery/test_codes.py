"""Codes against the distances of the vectors themselves."""

from __future__ import annotations

import numpy as np
import pytest

from igps.gallery import _codes
from igps.gallery._codes import CodeIndex, Coder


def families(
    n_families: int, n_members: int, noise: float, width: int = 64, seed: int = 0
) -> np.ndarray:
    generator = np.random.default_rng(seed)
    members = generator.standard_normal((n_families, 1, width)) + noise * generator.standard_normal(
        (n_families, n_members, width)
    )
    return members.reshape(-1, width).astype(np.float32)


def kept(vectors: np.ndarray, rows: np.ndarray | None = None) -> CodeIndex:
    coder = Coder.fit(vectors, "cosine")
    rows = np.arange(len(vectors), dtype=np.uint64) if rows is None else rows
    return CodeIndex(coder, coder(vectors), rows)


@pytest.mark.parametrize("width", [5, 64, 200, 256])
def test_estimates_are_right_on_average(width: int) -> None:
    """And off by no more than Gao and Long (2024) derive: √(π/2 - 1) / √256 of the product of the lengths, about."""
    vectors = families(1, 3000, 1.0, width)
    codes = kept(vectors)
    coder = codes._coder
    own = coder(vectors)
    rest = vectors @ coder.rotation.T - coder.centroids[own["centre"]]
    errors = []
    for query in families(1, 20, 1.0, width, seed=1):
        found = codes._distances(query, len(vectors))[codes._positions]
        away = coder.rotation @ query - coder.centroids[own["centre"]]
        lengths = np.linalg.norm(rest, axis=1) * np.linalg.norm(away, axis=1)
        # A vector that is a centre is known exactly.
        far = lengths > 1e-3
        errors.append(
            ((found - np.square(vectors - query).sum(axis=1)) / 2 / np.maximum(lengths, 1e-3))[far]
        )
    off = np.concatenate(errors)
    assert abs(off.mean()) < 0.003
    assert off.std() < 1.1 * np.sqrt((np.pi / 2 - 1) / 256)


def test_families_larger_than_what_is_asked_for_are_told_apart() -> None:
    """Members of one are far nearer to each other than to others: their codes are those of differences from centres."""
    vectors = families(8, 1000, 0.05)
    codes = kept(vectors)
    found = []
    for query in vectors[::400]:
        nearest = np.argsort(np.square(vectors - query).sum(axis=1))[:10]
        found.append(np.isin(nearest, codes.nearest(query, 100)).mean())
    assert np.mean(found) > 0.98


def test_codes_of_far_centres_are_passed_over() -> None:
    """Three quarters of them, and none of the nearest is lost."""
    vectors = families(40, 500, 0.2)
    codes = kept(vectors)
    for query in vectors[::900]:
        assert 0.7 < np.isinf(codes._distances(query, 1000)).mean() <= 0.75
        nearest = np.argsort(np.square(vectors - query).sum(axis=1))[:10]
        assert set(nearest.tolist()) <= set(codes.nearest(query, 200).tolist())


def test_rows_are_found_among_those_named_whatever_their_order() -> None:
    vectors = families(20, 300, 0.3)
    generator = np.random.default_rng(3)
    rows = generator.permutation(10**6)[: len(vectors)].astype(np.uint64)
    codes = kept(vectors, rows)
    for n_named in (0, 3, 50, 2000):
        chosen = generator.choice(len(vectors), n_named, replace=False)
        found = codes.nearest(vectors[7], 40, rows[chosen])
        assert len(found) == len(set(found.tolist())) == min(n_named, 40)
        away = np.square(vectors[chosen] - vectors[7]).sum(axis=1)
        assert set(rows[chosen[np.argsort(away)[:5]]].tolist()) <= set(found.tolist())
    assert sorted(codes.nearest(vectors[7], 10**4).tolist()) == sorted(rows.tolist())


def test_the_lowest_are_those_of_sorting() -> None:
    generator = np.random.default_rng(4)
    for n_values, n in ((10, 20), (10, 10), (3000, 7), (100_003, 500), (5000, 500)):
        for values in (
            generator.random(n_values),
            generator.integers(0, 3, n_values),
            np.sort(generator.random(n_values)),
        ):
            found = _codes._lowest(values.astype(np.float32), n)
            assert len(set(found.tolist())) == min(n, n_values)
            np.testing.assert_array_equal(np.sort(values[found]), np.sort(values)[:n])


def test_vectors_that_are_all_alike_are_found() -> None:
    codes = kept(np.ones((500, 16), np.float32))
    assert len(codes.nearest(np.ones(16, np.float32), 12)) == 12
    assert np.isfinite(codes._distances(np.zeros(16, np.float32), 500)).all()
