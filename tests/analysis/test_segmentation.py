"""Masks that have a closed form: balls that are hollow, drilled, cut, or not alone."""

import numpy as np
import pytest

from igps.analysis.segmentation import cavity_root, cut_end, gap_root, hole_root, stray_root

ONES = np.ones(3)


def offsets(half):
    """(3, X, Y, Z) from the middle of a grid."""
    return np.indices(3 * [2 * half + 1]) - half


def ball(radius, half=24):
    return (offsets(half) ** 2).sum(axis=0) <= radius**2


def drilled(radius, of_hole, half=24):
    """A ball with a tunnel along the diagonal of two axes, as no slice of the grid shows it closed."""
    x, y, z = offsets(half)
    return ball(radius, half) & ~((x - y) ** 2 / 2 + z**2 <= of_hole**2)


def test_a_ball_has_nothing_apart_no_hole_and_hardly_a_gap():
    whole = ball(20)
    assert stray_root(whole) == cavity_root(whole) == hole_root(whole) == 0
    assert gap_root(whole, ONES) ** 2 < 0.005


def test_what_lies_apart_is_counted_whichever_comes_first():
    large = ball(12, 28)
    small = np.roll(ball(6, 28), -20, axis=0)
    assert stray_root(large | small) ** 2 == pytest.approx(1 / 9, rel=0.05)


def test_a_cavity_is_the_ball_that_is_missing():
    hollow = ball(20) & ~ball(8)
    expected = pytest.approx(
        8**3 / (20**3 - 8**3),
        rel=0.05,
    )
    assert cavity_root(hollow) ** 2 == expected
    assert cavity_root(drilled(20, 5)) == 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_tunnel_along_an_axis_is_a_hole_in_the_slices_that_go_around_it(axis):
    """2 π r² √(R² - r²) of the ball, whose tunnel leaves 4/3 π (R² - r²)^(3/2)."""
    x, y, _ = np.moveaxis(offsets(24), axis + 1, 3)
    mask = np.moveaxis(
        ball(20) & (x**2 + y**2 > 5**2),
        2,
        axis,
    )
    expected = pytest.approx(
        1.5 * 5**2 / (20**2 - 5**2),
        rel=0.05,
    )
    assert hole_root(mask) ** 2 == expected


def test_a_bowl_has_a_hole_in_slices_and_no_cavity():
    """Its hollow is a half ball of half its radius: an eighth of the whole bowl, which lacks that eighth."""
    bowl = ball(20) & ~ball(10) & (offsets(24)[2] <= 0)
    assert hole_root(bowl) ** 2 == pytest.approx(1 / 7, rel=0.05)
    assert cavity_root(bowl) == 0


@pytest.mark.parametrize("of_hole", [3, 5])
def test_a_tunnel_is_a_gap_of_its_volume(of_hole):
    """A cylinder through the middle takes 4/3 π (R³ - (R² - r²)^(3/2)) from a ball."""
    missing = 20**3 - (20**2 - of_hole**2) ** 1.5
    found = gap_root(drilled(20, of_hole), ONES) ** 2
    expected = pytest.approx(missing / (20**3 - missing), rel=0.15)
    assert found == expected


def test_a_gap_does_not_depend_on_the_grid_and_not_on_the_unit():
    mask = drilled(20, 5)
    usual = gap_root(mask, ONES)
    assert gap_root(mask, 3 * ONES) == pytest.approx(usual)
    found = gap_root(
        np.repeat(mask, 2, axis=2),
        ONES * [1, 1, 0.5],
    )
    assert found == pytest.approx(usual, rel=0.1)
    coarser = gap_root(drilled(60, 15, 64), ONES)
    assert coarser == pytest.approx(usual, rel=0.1)


def test_a_cut_shows_unless_the_border_of_the_volume_made_it():
    half = ball(20, 20)[:, :, :26]
    inside = np.zeros((3, 2), dtype=bool)
    at_border = np.zeros((3, 2), dtype=bool)
    at_border[2, 1] = True
    expected = (1 - 0.4**0.5) * (np.pi * (20**2 - 5**2)) ** 0.5
    assert cut_end(half, inside) == pytest.approx(expected, rel=0.05)
    assert cut_end(half, at_border) < 2
