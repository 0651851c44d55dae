import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch import nn

from batches import batch_of, embedded, two_bodies
from igps.data.requirements import Requirements
from igps.nn.axes import (
    AXES,
    Attribute,
    BallRadius,
    EmbeddedPairCosines,
    EuclideanDistance,
    InteriorDistance,
    PairAxis,
    PairCosines,
    PairTwist,
    Potential,
    axis_of,
)
from igps.nn.axes.points import soft_memberships
from igps.nn.batch_features import SampleFeatures
from igps.nn.embedding import SpectralEmbedding
from loops import hat, soft_classes


def view(kind="interior"):
    batch = two_bodies()
    return SampleFeatures(batch, kind, getattr(batch, kind))


def test_hats_are_the_linear_kernel():
    values = torch.tensor(
        [0.0, 0.1, 0.3, 0.35, 0.5, 0.9, 1.0, 5.0],
        dtype=torch.float64,
    )
    centres = [0.1, 0.35, 0.4, 0.95]
    expected = [hat(float(value), centres) for value in values]
    result = soft_memberships(values, torch.tensor(centres, dtype=torch.float64))
    assert_allclose(result, expected, atol=1e-14)
    assert torch.equal(
        soft_memberships(
            values,
            torch.tensor([0.4]),
        ),
        torch.ones(8, 1, dtype=torch.float64),
    )
    in_rows = soft_memberships(
        values.view(2, 4),
        torch.tensor(centres, dtype=torch.float64),
    )
    assert_allclose(in_rows.flatten(0, 1), expected, atol=1e-14)


def test_hats_are_differentiable_in_both_arguments():
    values = torch.tensor(
        [0.0, 0.2, 0.37, 0.5, 2.0],
        dtype=torch.float64,
        requires_grad=True,
    )
    centres = torch.tensor([0.1, 0.35, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(soft_memberships, (values, centres))


@pytest.mark.parametrize(
    "axis", [Potential(4, 1.5), Attribute("depth", [0.1875, 0.5625, 0.9375, 1.3125])]
)
def test_hard_classes_are_those_of_the_nearest_centre(axis):
    values = torch.tensor([0.0, 0.3749, 0.375, 0.7, 0.75, 1.125, 1.5, 9.0])
    assert axis.memberships(values).tolist() == np.eye(4)[[0, 0, 1, 1, 2, 3, 3, 3]].tolist()
    assert axis.n_classes == 4


@pytest.mark.parametrize("options", [{}, {"soft": True, "learnable": True}])
@pytest.mark.parametrize("depths", [[0.1, 0.35, 0.4, 0.95], [0.4]])
def test_members_are_memberships_without_their_zeros(options, depths):
    axis = Attribute("depth", depths, **options)
    values = torch.tensor(
        [
            [0.0, 0.1, 0.3, 0.35],
            [0.5, 0.9, 1.0, torch.nan],
        ]
    )
    mask = values.isfinite()
    classes, weights = axis.members(values, mask)
    found = torch.zeros(2, 4, len(depths)).scatter_add(
        2,
        classes,
        weights.detach(),
    )
    torch.testing.assert_close(found[mask], axis.memberships(values[mask]).detach())
    with pytest.raises(ValueError, match="Attribute: expected finite values, got NaN or infinity"):
        axis.members(values, torch.ones_like(mask))


@pytest.mark.parametrize("learnable", [False, True])
def test_soft_classes_are_hats(learnable):
    axis = Potential(3, 0.9, soft=True, learnable=learnable)
    values = torch.linspace(0, 1.2, 30)
    assert_allclose(
        axis.memberships(values).detach(), soft_classes(values, [0.15, 0.45, 0.75]), atol=1e-6
    )
    assert len(list(axis.parameters())) == learnable


def test_learned_hard_classes_are_hard_and_have_the_derivative_of_soft_ones():
    axes = {soft: Potential(3, 0.9, soft=soft, learnable=True) for soft in (False, True)}
    values = torch.linspace(0, 1.2, 30, requires_grad=True)
    upstream = torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(
        axes[False].memberships(values),
        Potential(3, 0.9).memberships(values),
    )
    found, expected = (
        torch.autograd.grad(
            (axis.memberships(values) * upstream).sum(), [values, *axis.parameters()]
        )
        for axis in axes.values()
    )
    torch.testing.assert_close(found, expected)
    for gradient in found:
        assert bool(gradient.any())


def test_values_of_points():
    seen = view()
    potential = Potential().values(seen, SpectralEmbedding(n_eigenpairs=4))
    for i, n in enumerate((40, 25)):
        assert_allclose(
            potential[i, :n], embedded(two_bodies(), i, n_eigenpairs=4).norm(dim=1), rtol=1e-5
        )
    assert torch.equal(
        Attribute("depth", [0.1, 0.2]).values(
            seen,
            nn.Identity(),
        ),
        seen.samples.attributes["depth"],
    )


def test_values_that_are_not_finite_are_refused():
    for soft in (False, True):
        with pytest.raises(
            ValueError, match="Attribute: expected finite values, got NaN or infinity"
        ):
            Attribute("depth", [0.1, 0.2], soft=soft).memberships(torch.tensor([0.1, torch.nan]))


def test_a_missing_attribute_lists_what_there_is():
    with pytest.raises(
        ValueError,
        match=r"attributes: expected the surface samples to have 'charge', got \['depth', 'surface_direction'\]",
    ):
        Attribute("charge", [0.1, 0.2]).values(view("surface"), nn.Identity())
    bare = batch_of(torch.rand(1, 5, 3))
    with pytest.raises(
        ValueError, match="expected the interior samples to have 'surface_direction'"
    ):
        PairCosines().pairs(SampleFeatures(bare, "interior", bare.interior), SpectralEmbedding())


def test_directions_are_no_classes():
    with pytest.raises(
        ValueError, match="expected a scalar, got 'surface_direction', which is a direction"
    ):
        Attribute("surface_direction", [0.0, 1.0]).values(view(), nn.Identity())


def test_needs():
    fine = SpectralEmbedding(n_eigenpairs=9)
    coarse = SpectralEmbedding(n_eigenpairs=2)
    assert Potential().requirements(fine) == Requirements(n_eigenpairs=9)
    assert InteriorDistance().requirements(fine) == Requirements(n_eigenpairs=9)
    assert InteriorDistance(embedding=coarse).requirements(fine) == Requirements(n_eigenpairs=2)
    # What has no number of its own takes all there are.
    assert InteriorDistance().requirements(SpectralEmbedding()) == Requirements(whole_spectrum=True)
    assert InteriorDistance().requirements(nn.Identity()) == Requirements(whole_spectrum=True)
    assert EuclideanDistance().requirements(fine) == Requirements()
    assert PairCosines().requirements(fine) == Requirements(attributes=("surface_direction",))
    assert EmbeddedPairCosines().requirements(fine) == Requirements(n_eigenpairs=9)
    assert PairTwist().requirements(fine) == Requirements(attributes=("surface_direction",))
    assert BallRadius().requirements(fine) == Requirements(attributes=("surface_direction",))
    assert Potential(embedding=coarse).requirements(fine) == Requirements(n_eigenpairs=2)
    assert Attribute("depth", [0.1]).requirements(fine) == Requirements(attributes=("depth",))
    assert Attribute("one of my own", [0.1]).requirements(fine) == Requirements()


def test_named_axes_are_made_as_they_are_by_default():
    assert {name: type(axis_of(name)) for name in AXES} == dict(AXES)
    assert isinstance(axis_of("interior_distance"), PairAxis)
    assert_allclose(
        axis_of("potential").centres(),
        np.arange(4) * 0.375 + 0.1875,
        rtol=1e-6,
    )


def test_a_wrong_name_lists_the_axes():
    with pytest.raises(
        ValueError, match=r"axes: expected one of potential, interior_distance, .*, got 'geodesic'"
    ):
        axis_of("geodesic")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: InteriorDistance(1), "n_bins: expected at least 2, got 1"),
        (lambda: PairTwist(1), "n_bins: expected at least 2, got 1"),
        (lambda: PairCosines(1), "n_bins: expected at least 2, got 1"),
        (lambda: InteriorDistance(reach=0.0), "reach: expected a positive number, got 0"),
        (lambda: Potential(0), "n_classes: expected at least 1, got 0"),
        (lambda: Potential(2.5), "n_classes: expected a whole number, got 2.5"),
        (
            lambda: Attribute("depth", [0.2, 0.1]),
            "start: expected finite values in ascending order",
        ),
    ],
)
def test_impossible_axes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
