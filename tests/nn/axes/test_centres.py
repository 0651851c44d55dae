import numpy as np
import pytest
import torch

from igps.nn.axes.centres import OrderedCentres, interval_centres


def test_interval_centres_lie_in_the_middle_of_equal_intervals():
    edges = np.linspace(0, 1.5, 5)
    np.testing.assert_allclose(
        interval_centres(4, 1.5, "n_classes"), (edges[1:] + edges[:-1]) / 2, rtol=1e-6
    )


@pytest.mark.parametrize(
    ("n", "largest"),
    [(0, 1.0), (3, 0.0), (3, float("inf"))],
)
def test_impossible_intervals_are_refused(n, largest):
    expected = (
        "n_bins: expected at least 1, got 0"
        if n == 0
        else f"reach: expected a positive number, got {largest}"
    )
    with pytest.raises(ValueError, match=expected):
        interval_centres(n, largest, "n_bins")


@pytest.mark.parametrize(
    "start",
    [[0.1, 0.2, 0.5, 0.6], [-3.0, -1.0, 0.0, 7.0], [0.4]],
)
def test_learned_centres_stay_in_order(start):
    centres = OrderedCentres(start, learnable=True)
    assert centres.log_gap is not None
    np.testing.assert_allclose(centres().detach(), start, atol=1e-6)
    generator = torch.Generator().manual_seed(0)
    for spread in (1.0, 30.0, 1000.0):
        with torch.no_grad():
            centres.log_gap.copy_(torch.randn(len(start), generator=generator) * spread)
        values = centres()
        assert (values.diff() > 0).all()
        assert start[0] < 0 or values[0] > 0


def test_fixed_centres_are_a_copy_and_no_parameters():
    start = torch.tensor([0.1, 0.4])
    centres = OrderedCentres(start)
    start += 1
    torch.testing.assert_close(centres(), torch.tensor([0.1, 0.4]))
    assert list(centres.parameters()) == []


@pytest.mark.parametrize(
    "start",
    [[0.1, 0.1], [], [0.1, float("nan")], [[0.1, 0.2]]],
)
def test_centres_that_do_not_ascend_are_refused(start):
    with pytest.raises(ValueError, match="start: expected finite values in ascending order"):
        OrderedCentres(start)
