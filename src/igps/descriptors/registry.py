"""Descriptors by name."""

import importlib
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import get_args

import torch

from igps._parameters import check_one_of
from igps.descriptors.canonical_form import CanonicalForm
from igps.descriptors.d2 import D2
from igps.descriptors.from_yaml import load_yaml
from igps.descriptors.geodesic_spectral import GeodesicSpectral
from igps.descriptors.gps import gps
from igps.descriptors.individual import SIDE, SIZE, IndividualDescriptor, Mirror, Size, keeps_size
from igps.descriptors.inner_distance import InnerDistance
from igps.descriptors.interior import interior
from igps.descriptors.local_diameter_centricity import LocalDiameterCentricity
from igps.descriptors.molecular import molecular
from igps.descriptors.multiscale import multiscale
from igps.descriptors.pretrained.descriptor import pretrained
from igps.descriptors.rich import rich
from igps.descriptors.shape_dna import ShapeDNA
from igps.descriptors.spectral_gw import SpectralGromovWasserstein
from igps.descriptors.volume_shape_dna import VolumeShapeDNA
from igps.descriptors.with_attributes import WithAttributes
from igps.nn.descriptor import NAME, Descriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads import ClassifierHead
from igps.nn.specification import IN_FOLDER, load_module

_MAKERS: Mapping[str, Callable[[], Descriptor]] = {
    "interior": interior,
    "gps": gps,
    "multiscale": multiscale,
    "rich": rich,
    "pretrained": pretrained,
    "d2": D2,
    "shape_dna": ShapeDNA,
    "volume_shape_dna": VolumeShapeDNA,
    "local_diameter_centricity": LocalDiameterCentricity,
    "inner_distance": InnerDistance,
    "canonical_form": CanonicalForm,
    "geodesic_spectral": GeodesicSpectral,
    "spectral_gw": SpectralGromovWasserstein,
    "molecular": molecular,
}

# "molecular" needs attributes that only molecules bring
NAMES: tuple[str, ...] = tuple(name for name in _MAKERS if name != "molecular")
"""The names of the library's descriptors of any body."""

_MARK = re.compile(r"\+(?:size|side)(?=\+|$)")
_WITH = re.compile(r"\+(\w+)(?:=(\d+\.?\d*|\.\d+))?")
_WRITTEN = (".yaml", ".yml")


def is_file(which: str | Path) -> bool:
    """Whether a descriptor is asked for by its file, or by its folder."""
    if str(which) in _MAKERS:
        return False
    in_folder = bool(which) and os.path.isfile(os.path.join(which, IN_FOLDER))  # False of what cannot be a path
    return str(which).lower().endswith((".safetensors", *_WRITTEN)) or in_folder


def load(path: str | Path) -> Descriptor:
    """A descriptor that `Descriptor.save` or `igps fit` wrote, in evaluation mode, with its `card`. No code runs.

    From a file or a folder. Or one that is written in YAML, see `igps.descriptors.from_yaml`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     descriptor("interior").save(f"{folder}/mine.safetensors", {"author": "me"})
        ...     loaded = load(f"{folder}/mine.safetensors")
        >>> loaded.name, dict(loaded.card)
        ('interior', {'author': 'me'})

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is another file, or a damaged one.
    """
    if str(path).lower().endswith(_WRITTEN):
        return load_yaml(path)
    module, card = load_module(path)
    if not isinstance(module, Descriptor):
        raise ValueError(f"{path}: expected a descriptor, got {type(module).__name__}.")
    if not NAME.fullmatch(module.name):
        raise ValueError(f"{path}: expected a descriptor's name of letters, digits and _, got {module.name[:80]!r}.")
    _check_heads(module, path)
    module.card = card
    scale = card.get("scale")  # a card of one's own may say anything by this word
    if isinstance(scale, int | float) and 0 < scale < math.inf:
        module.scale = scale
    return module


def _check_heads(module: Descriptor, path: str | Path) -> None:
    """Raise a ValueError where sizes of a head do not fit each other, which else shows when all is described."""
    for one in module.modules():
        if not isinstance(one, EmbeddedDescriptor) or not isinstance(one.descriptor, HistogramDescriptor):
            continue
        cells = torch.ones(2, one.descriptor.n_features)
        try:
            one.head(cells)
            if isinstance(one.head, ClassifierHead):
                one.head.strangeness(cells)
        except (ValueError, RuntimeError, TypeError, LookupError, ArithmeticError) as error:
            raise ValueError(f"{path}: expected a head of {cells.shape[1]} cells ({error}). Save it again.") from error


def descriptor(
    which: str | Path | Descriptor,
    *,
    size: Size = "ignore",
    mirror: Mirror = "same",
    units: Sequence[str | None] | None = None,
) -> Descriptor:
    """A descriptor by its name or file, in evaluation mode; one that is given is returned as it is.

    Example:
        >>> descriptor("interior").requirements.n_eigenpairs
        250
        >>> descriptor("rich", size="keep", mirror="distinct").name, descriptor("rich+size").name
        ('rich+side+size', 'rich+size')

    Args:
        which: one of `NAMES`, or "molecular"; or a file, see `load`; or "package.module:NAME", where NAME is a
            descriptor of your own or makes one when called; or a descriptor. "+size" behind a name keeps size, "+side"
            tells mirror images apart, "+ct" or "+ct=0.5" adds an attribute, see `WithAttributes`.
        size: "keep" lets differences in size count, see `IndividualDescriptor`; "auto" where all bodies have a unit of
            length.
        mirror: "distinct" tells a body from its mirror image.
        units: of the bodies, for size="auto", see `SignatureDataset.units`.

    Raises:
        ValueError: no descriptor has this name, or see `load`.
    """
    check_one_of(get_args(Size), size=size)
    check_one_of(get_args(Mirror), mirror=mirror)
    if size == "auto" and units is None:
        raise ValueError('size: expected "keep" or "ignore", or the units of the bodies beside "auto", got none.')
    marks = ""
    if isinstance(which, str):
        marks, which = "".join(_MARK.findall(which)), _MARK.sub("", which)
    plain = _plain(which)
    with_size = SIZE in marks or (size == "keep" if units is None else keeps_size(size, units)[0])
    with_side = SIDE in marks or mirror == "distinct"
    if not (with_size or with_side):
        return plain
    scale = plain.scale
    if isinstance(plain, IndividualDescriptor):  # of a file
        with_size, with_side = with_size or plain.keeps_size, with_side or plain.twists is not None
        plain = plain.descriptor
    return IndividualDescriptor(plain, size=with_size, side=with_side, scale=scale).eval()


def _plain(which: str | Path | Descriptor) -> Descriptor:
    if isinstance(which, Descriptor):
        return which
    if is_file(which):
        return load(which)
    which = str(which)
    base, *words = re.split(r"(?=\+)", which)
    found = [_WITH.fullmatch(word) for word in words]
    if words:
        if not all(found):
            told = "expected +NAME or +NAME=WEIGHT behind a descriptor, such as +ct=0.5, the weight above 0"
            raise ValueError(f"descriptor: {told}, got {which!r}.")
        attributes, weights = zip(*((one[1], float(one[2] or 1)) for one in found if one), strict=True)
        return WithAttributes(_plain(base), attributes, weights).eval()
    if which in _MAKERS:
        return _MAKERS[which]().eval()
    module, colon, name = which.partition(":")
    if not colon:
        raise ValueError(
            f"descriptor: expected one of {', '.join(_MAKERS)}, or package.module:NAME of one of your own, got "
            f"{which!r}."
        )
    try:
        own = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"descriptor: expected package.module:NAME to be importable, got {which!r} ({error}). Check the spelling, "
            "and that its folder is on the Python path."
        ) from error
    try:
        made = own if isinstance(own, Descriptor) or not callable(own) else own()
    except TypeError as error:
        raise ValueError(f"descriptor: expected {which} to make one without arguments ({error}).") from error
    if not isinstance(made, Descriptor):
        raise ValueError(
            f"descriptor: expected {which} to be or to make an igps.Descriptor, got {type(made).__name__}."
        )
    return made.eval()
