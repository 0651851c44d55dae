"""Descriptors by name."""

import importlib
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import get_args

import torch

from igps._parameters import check_one_of
from igps.descriptors.from_yaml import load_yaml
from igps.descriptors.gps import gps
from igps.descriptors.interior import interior
from igps.descriptors.literature.canonical_form import CanonicalForm
from igps.descriptors.literature.d2 import D2
from igps.descriptors.literature.geodesic_spectral import GeodesicSpectral
from igps.descriptors.literature.inner_distance import InnerDistance
from igps.descriptors.literature.local_diameter_centricity import LocalDiameterCentricity
from igps.descriptors.literature.shape_dna import ShapeDNA
from igps.descriptors.literature.spectral_gw import SpectralGromovWasserstein
from igps.descriptors.literature.volume_shape_dna import VolumeShapeDNA
from igps.descriptors.molecular import molecular
from igps.descriptors.multiscale import multiscale
from igps.descriptors.pretrained.descriptor import pretrained
from igps.descriptors.rich import rich
from igps.descriptors.size_and_side import SIDE, SIZE, Mirror, Size, SizeAndSide, keeps_size
from igps.descriptors.with_attributes import WithAttributes
from igps.nn.descriptor import NAME, Descriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads import ClassifierHead
from igps.nn.specification import IN_FOLDER, load_module

_FACTORIES: Mapping[str, Callable[[], Descriptor]] = {
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

# "molecular" needs attributes that only molecules have
NAMES: tuple[str, ...] = tuple(name for name in _FACTORIES if name != "molecular")
"""The names of the library's descriptors that describe any body."""

_INDIVIDUAL_SUFFIX = re.compile(r"\+(?:size|side)(?=\+|$)")
_ATTRIBUTE_SUFFIX = re.compile(r"\+(\w+)(?:=(\d+\.?\d*|\.\d+))?")
_YAML_SUFFIXES = (".yaml", ".yml")


def is_file(which: str | Path) -> bool:
    """Return whether an argument for a descriptor is the path of a descriptor's file or folder."""
    if str(which) in _FACTORIES:
        return False
    is_folder = bool(which) and os.path.isfile(
        os.path.join(which, IN_FOLDER)
    )  # False if `which` is no valid path
    return str(which).lower().endswith((".safetensors", *_YAML_SUFFIXES)) or is_folder


def load(path: str | Path) -> Descriptor:
    """Load a descriptor from a file or folder, in evaluation mode, with its `card`. No code from the file runs.

    The file was written by `Descriptor.save` or `igps fit`, or is a specification in YAML, see
    `igps.descriptors.from_yaml`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     descriptor("interior").save(f"{folder}/mine.safetensors", {"author": "me"})
        ...     loaded = load(f"{folder}/mine.safetensors")
        >>> loaded.name, dict(loaded.card)
        ('interior', {'author': 'me'})

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, or does not hold a descriptor.
    """
    if str(path).lower().endswith(_YAML_SUFFIXES):
        return load_yaml(path)
    module, card = load_module(path)
    if not isinstance(module, Descriptor):
        raise ValueError(f"{path}: expected a descriptor, got {type(module).__name__}.")
    if not NAME.fullmatch(module.name):
        raise ValueError(
            f"{path}: expected a descriptor's name of letters, digits and _, got {module.name[:80]!r}."
        )
    _check_heads(module, path)
    module.card = card
    scale = card.get("scale")  # cards may come from users: this entry may be anything
    if isinstance(scale, int | float) and 0 < scale < math.inf:
        module.scale = scale
    return module


def _check_heads(module: Descriptor, path: str | Path) -> None:
    """Raise a ValueError if the sizes of a head's tensors are inconsistent, before any body is described."""
    for submodule in module.modules():
        if not isinstance(submodule, EmbeddedDescriptor) or not isinstance(
            submodule.descriptor, HistogramDescriptor
        ):
            continue
        head, cells = submodule.head, torch.ones(2, submodule.descriptor.n_features)
        try:
            head(cells)
            if isinstance(head, ClassifierHead):
                head.strangeness(cells)
        except (ValueError, RuntimeError, TypeError, LookupError, ArithmeticError) as error:
            raise ValueError(
                f"{path}: expected a head for {cells.shape[1]} cells ({error}). Save it again."
            ) from error


def descriptor(
    which: str | Path | Descriptor,
    *,
    size: Size = "ignore",
    mirror: Mirror = "same",
    units: Sequence[str | None] | None = None,
) -> Descriptor:
    """Return a descriptor by its name or file, in evaluation mode; a descriptor object is returned as it is.

    Example:
        >>> descriptor("interior").requirements.n_eigenpairs
        250
        >>> descriptor("rich", size="keep", mirror="distinct").name, descriptor("rich+size").name
        ('rich+side+size', 'rich+size')

    Args:
        which: one of `NAMES`, or "molecular"; or a file, see `load`; or "package.module:NAME", where NAME is a
            descriptor of your own or a function that makes one; or a descriptor. The suffix "+size" of a name compares
            size, "+side" distinguishes mirror images, "+ct" or "+ct=0.5" adds an attribute, see `WithAttributes`.
        size: "keep" compares size, see `SizeAndSide`; "auto" does so if all bodies have a unit of length.
        mirror: "distinct" distinguishes a body from its mirror image.
        units: of the bodies, for size="auto", see `SignatureDataset.units`.

    Raises:
        ValueError: no descriptor has this name, or the file is not valid, see `load`.
    """
    check_one_of(get_args(Size), size=size)
    check_one_of(get_args(Mirror), mirror=mirror)
    if size == "auto" and units is None:
        raise ValueError(
            'size: expected "keep" or "ignore", or "auto" with the units of the bodies, got no units.'
        )
    suffixes = ""
    if isinstance(which, str):
        suffixes, which = (
            "".join(_INDIVIDUAL_SUFFIX.findall(which)),
            _INDIVIDUAL_SUFFIX.sub("", which),
        )
    base = _base_descriptor(which)
    with_size = SIZE in suffixes or (
        size == "keep" if units is None else keeps_size(size, units)[0]
    )
    with_side = SIDE in suffixes or mirror == "distinct"
    if not (with_size or with_side):
        return base
    scale = base.scale
    if isinstance(base, SizeAndSide):  # loaded from a file
        with_size, with_side = with_size or base.keeps_size, with_side or base.twists is not None
        base = base.descriptor
    return SizeAndSide(base, size=with_size, side=with_side, scale=scale).eval()


def attributes_suffix(attributes: Iterable[str]) -> str:
    """Return the suffix of a name that combines a descriptor with attributes NAME or NAME=WEIGHT."""
    suffixes = [f"+{attribute}" for attribute in attributes]
    if wrong := [suffix[1:] for suffix in suffixes if not _ATTRIBUTE_SUFFIX.fullmatch(suffix)]:
        raise ValueError(
            f"with: expected NAME or NAME=WEIGHT with a weight above 0, such as ct=0.5, got {wrong[0]!r}."
        )
    return "".join(suffixes)


def _base_descriptor(which: str | Path | Descriptor) -> Descriptor:
    """Return a descriptor by its name without "+size" and "+side", or by its file."""
    if isinstance(which, Descriptor):
        return which
    if is_file(which):
        return load(which)
    which = str(which)
    base, *suffixes = re.split(r"(?=\+)", which)
    if suffixes:
        matches = [match for suffix in suffixes if (match := _ATTRIBUTE_SUFFIX.fullmatch(suffix))]
        if len(matches) < len(suffixes):
            raise ValueError(
                "descriptor: expected +NAME or +NAME=WEIGHT after the name of a descriptor, such as +ct=0.5, with a "
                f"weight above 0, got {which!r}."
            )
        attributes, weights = zip(
            *((match[1], float(match[2] or 1)) for match in matches), strict=True
        )
        return WithAttributes(_base_descriptor(base), attributes, weights).eval()
    if which in _FACTORIES:
        return _FACTORIES[which]().eval()
    module, colon, name = which.partition(":")
    if not colon:
        raise ValueError(
            f"descriptor: expected one of {', '.join(_FACTORIES)}, or package.module:NAME of a descriptor of your own, "
            f"got {which!r}."
        )
    try:
        own = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"descriptor: expected package.module:NAME to be importable, got {which!r} ({error}). Check the spelling, "
            "and that the folder of the module is on the Python path."
        ) from error
    try:
        instance = own if isinstance(own, Descriptor) or not callable(own) else own()
    except TypeError as error:
        raise ValueError(
            f"descriptor: expected {which} to make one without arguments ({error})."
        ) from error
    if not isinstance(instance, Descriptor):
        raise ValueError(
            f"descriptor: expected {which} to be or to make an igps.Descriptor, got {type(instance).__name__}."
        )
    return instance.eval()
