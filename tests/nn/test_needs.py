from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from batches import batch_of, two_bodies
from torch import nn

from igps.geometry.signature import SignatureConfig
from igps.nn.embedding import SpectralEmbedding
from igps.nn.needs import Needs, needs_of_embedding


def test_together_is_what_both_need() -> None:
    one, other = Needs(5, ("depth", "surface_direction")), Needs(9, ("electrostatic_potential", "depth"), mesh=True)
    assert one | other == Needs(9, ("depth", "surface_direction", "electrostatic_potential"), mesh=True)
    assert one | Needs() == Needs() | one == one


def test_completed_configuration_satisfies_what_is_needed() -> None:
    needs = Needs(30, ("surface_direction", "depth"))
    config = SignatureConfig(n_eigenpairs=40, attributes=("depth",), resolution=17)
    with pytest.raises(ValueError, match="surface_direction"):
        needs.check_config(config)
    completed = needs.completed(config)
    needs.check_config(completed)
    assert completed == replace(config, attributes=("depth", "surface_direction"))
    with pytest.raises(ValueError, match="n_eigenpairs: this descriptor needs signatures of at least 30, got 29"):
        needs.completed(SignatureConfig(n_eigenpairs=29))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (SignatureConfig(n_eigenpairs=11, attributes=("depth",)), "n_eigenpairs: .* at least 12, got 11.* Raise"),
        (SignatureConfig(n_eigenpairs=12), r"attributes: .* signatures with depth, got \[\]. Compute them with"),
    ],
)
def test_a_configuration_that_lacks_something_is_refused(config: SignatureConfig, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Needs(12, ("depth",)).check_config(config)


def test_a_batch_that_lacks_something_is_refused() -> None:
    """The second shape has seven eigenpairs; what is padded is none."""
    batch = two_bodies()
    Needs(7, ("depth", "surface_direction")).check(batch)
    with pytest.raises(ValueError, match="n_eigenpairs: this descriptor needs signatures of at least 8, got 7"):
        Needs(8).check(batch)
    with pytest.raises(
        ValueError,
        match=r"attributes: this descriptor needs signatures with electrostatic_potential, "
        r"got \['depth', 'surface_direction'\]",
    ):
        Needs(attributes=("depth", "electrostatic_potential")).check(batch)
    with pytest.raises(ValueError, match=r"meshes: this descriptor needs the surfaces too. Make the batch by"):
        Needs(mesh=True).check(batch)
    Needs().check(batch_of(torch.rand(1, 5, 3)))


def test_needs_of_an_embedding_are_its_eigenpairs() -> None:
    assert needs_of_embedding(SpectralEmbedding(n_eigenpairs=6)) == Needs(6)
    assert needs_of_embedding(SpectralEmbedding()) == needs_of_embedding(nn.Identity()) == Needs()
