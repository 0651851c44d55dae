from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from batches import batch_of, two_bodies
from igps.data.requirements import Requirements, embedding_requirements
from igps.descriptors import NAMES, descriptor
from igps.nn.descriptor import BodyDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.signature.signature import SignatureConfig


def test_together_is_what_both_need():
    one = Requirements(5, ("depth", "surface_direction"))
    other = Requirements(9, ("electrostatic_potential", "depth"), mesh=True)
    assert one | other == Requirements(
        9, ("depth", "surface_direction", "electrostatic_potential"), mesh=True
    )
    assert one | Requirements() == Requirements() | one == one


def test_completed_configuration_satisfies_what_is_needed():
    requirements = Requirements(30, ("surface_direction", "depth"))
    config = SignatureConfig(n_eigenpairs=40, attributes=("depth",), resolution=17)
    with pytest.raises(ValueError, match="surface_direction"):
        requirements.check_config(config)
    completed = requirements.apply_to(config)
    requirements.check_config(completed)
    assert completed == replace(config, attributes=("depth", "surface_direction"))
    with pytest.raises(
        ValueError, match="n_eigenpairs: this descriptor needs signatures of at least 30, got 29"
    ):
        requirements.apply_to(SignatureConfig(n_eigenpairs=29))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            SignatureConfig(n_eigenpairs=11, attributes=("depth",)),
            "n_eigenpairs: .* at least 12, got 11.* Raise",
        ),
        (
            SignatureConfig(n_eigenpairs=12),
            r"attributes: .* signatures with depth, got \[\]. Compute them with",
        ),
    ],
)
def test_a_configuration_that_lacks_something_is_refused(config, message):
    with pytest.raises(ValueError, match=message):
        Requirements(12, ("depth",)).check_config(config)


def test_a_batch_that_lacks_something_is_refused():
    """The second shape has seven eigenpairs; what is padded is none."""
    batch = two_bodies()
    Requirements(7, ("depth", "surface_direction")).check(batch)
    with pytest.raises(
        ValueError, match="n_eigenpairs: this descriptor needs signatures of at least 8, got 7"
    ):
        Requirements(8).check(batch)
    with pytest.raises(
        ValueError,
        match=r"attributes: this descriptor needs signatures with electrostatic_potential, "
        r"got \['depth', 'surface_direction'\]",
    ):
        Requirements(attributes=("depth", "electrostatic_potential")).check(batch)
    with pytest.raises(
        ValueError, match=r"meshes: this descriptor needs the surfaces too. Make the batch by"
    ):
        Requirements(mesh=True).check(batch)
    Requirements().check(batch_of(torch.rand(1, 5, 3)))


def test_needs_of_an_embedding_are_its_eigenpairs():
    assert embedding_requirements(SpectralEmbedding(n_eigenpairs=6)) == Requirements(6)
    assert embedding_requirements(SpectralEmbedding()) == Requirements(whole_spectrum=True)
    assert embedding_requirements(nn.Identity()) == Requirements(whole_spectrum=True)


@pytest.mark.parametrize(
    ("needs", "n_eigenpairs"),
    [
        (Requirements(), 64),
        (Requirements(50), 64),
        (Requirements(100), 100),
        (Requirements(100) | Requirements(250), 250),
        (Requirements(50) | Requirements(whole_spectrum=True), 250),
        (Requirements(300, whole_spectrum=True), 300),
    ],
)
def test_as_many_eigenpairs_as_needed_where_no_number_is_given(needs, n_eigenpairs):
    """64 or more, on which the order of the samples depends; a mesh has room for 250 in any case."""
    completed = needs.apply_to(SignatureConfig(resolution=17))
    assert completed.n_eigenpairs == n_eigenpairs
    assert completed.resolution == 17
    assert completed.n_vertices_read == max(252, n_eigenpairs + 2)
    needs.check_config(completed)
    explicit = SignatureConfig(n_eigenpairs=311)
    assert needs.apply_to(explicit) == explicit
    paper = SignatureConfig.paper()
    if n_eigenpairs <= 250:
        assert needs.apply_to(paper) == paper
    else:
        with pytest.raises(ValueError, match="at least 300, got 250"):
            needs.apply_to(paper)
    assert needs.apply_to(SignatureConfig(least_vertices=2000)).n_vertices_read == 2000


def test_what_a_descriptor_does_not_say_is_all():
    class Own(BodyDescriptor):
        def describe_body(self, body):
            return body.eigenvalues.astype(np.float32)

    assert Own().requirements.apply_to(SignatureConfig()).n_eigenpairs == 250


def test_no_descriptor_needs_more_eigenpairs_than_are_computed_by_default():
    for name in NAMES:
        needs = descriptor(name).requirements
        n_eigenpairs = needs.apply_to(SignatureConfig()).n_eigenpairs
        assert n_eigenpairs <= SignatureConfig.DEFAULT_EIGENPAIRS, name
        assert needs.whole_spectrum is False, name
