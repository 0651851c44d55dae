"""Descriptors by name, by import path, and as objects; and what they need of signatures."""

import re
from dataclasses import replace

import pytest
import torch

import igps
from igps.descriptors import NAMES
from igps.descriptors.literature.d2 import D2
from igps.signature.signature import SignatureConfig
from own_descriptors import changed

FOURTEEN = (
    "interior",
    "gps",
    "multiscale",
    "rich",
    "pretrained",
    "d2",
    "shape_dna",
    "volume_shape_dna",
    "local_diameter_centricity",
    "inner_distance",
    "canonical_form",
    "geodesic_spectral",
    "spectral_gw",
    "measures",
)

OWN = """
import numpy as np

import igps
from igps.descriptors.literature.d2 import D2
from own_descriptors import changed


class Roundness(igps.BodyDescriptor):
    name = "roundness"

    def describe_body(self, body):
        return np.array([body.volume / body.area**1.5])

    def distances(self, queries, gallery):
        return (queries - gallery.T).abs()


def coarse():
    return changed(D2(), n_bins=8)


ready = changed(D2(), n_bins=16)
number = 5


def nothing():
    return None
"""


@pytest.fixture
def own(on_path):
    """A package with a module of one's own on the Python path."""
    package = f"mine_{on_path.name}"
    (on_path / package).mkdir()
    (on_path / package / "__init__.py").write_text("")
    (on_path / package / "shapes.py").write_text(OWN)
    return f"{package}.shapes"


def test_names_are_the_fourteen():
    assert NAMES == FOURTEEN


def test_a_wrong_name_lists_all():
    names = ", ".join((*FOURTEEN, "composition", "fold", "molecular"))
    with pytest.raises(
        ValueError, match=f"^descriptor: expected one of {names}, or .*, got 'best'"
    ):
        igps.descriptor("best")


def test_an_object_is_itself():
    mine = changed(D2(), n_bins=3)
    assert igps.descriptor(mine) is mine


def test_own_class_function_and_object_by_import_path(own, blob):
    config = SignatureConfig(n_eigenpairs=5, resolution=6, min_samples=0, n_surface_samples=50)
    batch = igps.collate([igps.compute_signature(blob, config)])
    made = {name: igps.descriptor(f"{own}:{name}") for name in ("Roundness", "coarse", "ready")}
    for one in made.values():
        assert isinstance(one, igps.Descriptor)
        assert not one.training
    assert made["Roundness"].name == "roundness"
    assert made["Roundness"](batch).item() == pytest.approx(blob.volume / blob.area**1.5)
    torch.testing.assert_close(made["coarse"](batch), changed(D2(), n_bins=8)(batch))
    torch.testing.assert_close(made["ready"](batch), changed(D2(), n_bins=16)(batch))
    assert igps.descriptor(f"{own}:ready") is made["ready"]


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (
            "no.such.module:NAME",
            "expected package.module:NAME to be importable, got 'no.such.module:NAME'",
        ),
        ("OWN:missing", "to be importable, .*missing"),
        ("OWN:number", "number to be or to make an igps.Descriptor, got int"),
        ("OWN:nothing", "nothing to be or to make an igps.Descriptor, got NoneType"),
    ],
)
def test_what_is_no_descriptor_is_refused(own, path, message):
    with pytest.raises(ValueError, match=message):
        igps.descriptor(path.replace("OWN", own))


def test_what_a_descriptor_needs_is_added_or_asked_for():
    config = SignatureConfig(n_eigenpairs=50, attributes=("electrostatic_potential",))
    names = ("electrostatic_potential", "depth", "surface_direction")
    applied = igps.descriptor("rich").requirements.apply_to(config)
    assert applied == replace(config, attributes=names)
    assert igps.descriptor("d2").requirements.apply_to(config) == config
    for name, least in (("pretrained", 90), ("rich", 50), ("interior", 250)):
        needs = igps.descriptor(name).requirements
        assert needs.n_eigenpairs == least
        needs.apply_to(SignatureConfig(n_eigenpairs=least))
        message = re.escape(
            f"n_eigenpairs: this descriptor needs signatures of at least {least}, got {least - 1}"
        )
        with pytest.raises(ValueError, match=message):
            needs.apply_to(SignatureConfig(n_eigenpairs=least - 1))
