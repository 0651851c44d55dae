"""Masks are damaged as it says: told by what scikit-image counts in them."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.measure import euler_number, label
from training.studies.mask_damages import DAMAGES, VARIED, damaged, varied

SPACING = np.array([1.0, 1.0, 1.5])
BALL = ((np.indices((48, 48, 36)).transpose(1, 2, 3, 0) - [23, 23, 17]) ** 2 * SPACING**2).sum(
    axis=-1
) <= 14**2
NONE = np.zeros_like(BALL)


def after(how: str, seed: int = 0) -> np.ndarray:
    """One of the six ways where there is one of that name."""
    one = damaged if how in DAMAGES else varied
    return one(BALL, SPACING, how, np.random.default_rng(seed), NONE)[0]


def n_pieces(mask: np.ndarray) -> int:
    return int(label(mask, connectivity=3).max())


@pytest.mark.parametrize("seed", range(5))
def test_a_varied_damage_is_what_it_is_called(seed: int) -> None:
    made = {how: varied(BALL, SPACING, how, np.random.default_rng(seed), NONE)[0] for how in VARIED}
    assert (n_pieces(BALL), n_pieces(~BALL), euler_number(BALL, 3)) == (1, 1, 1)
    assert n_pieces(after("island", seed)) == 2
    assert n_pieces(~made["cavity"]) == 2
    assert euler_number(made["tunnel"], 3) == 0
    assert 0.55 < np.count_nonzero(made["slices"]) / np.count_nonzero(BALL) < 0.95
    assert np.count_nonzero(made["leak"]) > 1.01 * np.count_nonzero(BALL)
    assert (made["leak"] >= BALL).all()
    assert (made["label"] == BALL).all()


def test_blocks_are_of_two_voxels_a_side() -> None:
    edges = [
        np.flatnonzero(np.diff(after("blocks").astype(int), axis=axis).any(axis=others)) % 2
        for axis, others in ((0, (1, 2)), (1, (0, 2)), (2, (0, 1)))
    ]
    assert [len(set(one.tolist())) for one in edges] == [1, 1, 1]


def test_a_leak_goes_where_another_body_is_near() -> None:
    near = np.roll(BALL, 28, axis=0) & ~BALL
    found = damaged(BALL, SPACING, "leak", np.random.default_rng(0), near)[0] & ~BALL
    assert np.argwhere(found)[:, 0].mean() > 30
    assert (found & near).any()


def test_a_hole_goes_through_along_the_slices() -> None:
    found = after("hole")
    assert euler_number(found, 3) == 0
    assert not found[23, 23].any()
