"""Descriptors by name."""

import importlib
import re
from collections.abc import Collection, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, get_args

from igps._parameters import check_one_of
from igps.descriptors.from_file import is_descriptor_file, load, with_values
from igps.descriptors.measures import Measures
from igps.descriptors.size_and_side import SIDE, SIZE, Mirror, Size, SizeAndSide, keeps_size
from igps.descriptors.with_attributes import WithAttributes
from igps.nn.descriptor import Descriptor
from igps.nn.layout import LayoutPart, layout_parts, with_layout

# Where each descriptor of the library is made: a class, or a function without arguments.
_LIBRARY: Mapping[str, str] = {
    "interior": "igps.descriptors.interior:interior",
    "gps": "igps.descriptors.gps:gps",
    "multiscale": "igps.descriptors.multiscale:multiscale",
    "rich": "igps.descriptors.rich:rich",
    "pretrained": "igps.descriptors.pretrained.descriptor:pretrained",
    "d2": "igps.descriptors.literature.d2:D2",
    "shape_dna": "igps.descriptors.literature.shape_dna:ShapeDNA",
    "volume_shape_dna": "igps.descriptors.literature.volume_shape_dna:VolumeShapeDNA",
    "local_diameter_centricity": (
        "igps.descriptors.literature.local_diameter_centricity:LocalDiameterCentricity"
    ),
    "inner_distance": "igps.descriptors.literature.inner_distance:InnerDistance",
    "canonical_form": "igps.descriptors.literature.canonical_form:CanonicalForm",
    "geodesic_spectral": "igps.descriptors.literature.geodesic_spectral:GeodesicSpectral",
    "spectral_gw": "igps.descriptors.literature.spectral_gw:SpectralGromovWasserstein",
    "measures": "igps.descriptors.measures:Measures",
    "composition": "igps.fields.molecules.composition:Composition",
    "fold": "igps.fields.molecules.fold:fold",
    "molecular": "igps.fields.molecules.molecular:molecular",
}

FIELD_NAMES: tuple[str, ...] = ("composition", "fold", "molecular")
"""The names of the library's descriptors that need attributes of molecules."""

NAMES: tuple[str, ...] = tuple(name for name in _LIBRARY if name not in FIELD_NAMES)
"""The names of the library's descriptors that describe any body."""

ENTRY_POINTS = "igps.descriptors"
"""The group of entry points by which other packages add descriptors."""

_SIZE_OR_SIDE = re.compile(r"\+(?:size|side)(?=\+|$)")
_ATTRIBUTE = re.compile(r"\+(\w+)(?:=(\d+\.?\d*|\.\d+))?")


@with_values
def descriptor(
    which: str | Path | Descriptor,
    *,
    size: Size = "ignore",
    mirror: Mirror = "same",
    units: Sequence[str | None] | None = None,
    learnable: bool | Collection[LayoutPart] = False,
    n_training_samples: int | None = None,
) -> Descriptor:
    """Return a descriptor by its name or file, in evaluation mode unless it draws samples.

    Example:
        >>> descriptor("interior").requirements.n_eigenpairs
        250
        >>> descriptor("rich", size="keep", mirror="distinct").name, descriptor("rich+size").name
        ('rich+side+size', 'rich+size')

    Args:
        which: one of `NAMES` or `FIELD_NAMES`; or a name that an installed package adds; or a file,
            see `load`; or "package.module:NAME", where NAME is a descriptor or makes one; or a
            descriptor, which is used as it is. The suffix "+size" of a name compares size, "+side" distinguishes mirror
            images, "+ct" or "+ct=0.5" adds an attribute, see `WithAttributes`.
        size: "keep" compares size, see `SizeAndSide`; "auto" does so if all bodies have a unit.
        mirror: "distinct" distinguishes a body from its mirror image.
        units: units of length of the bodies, for size="auto", see `SignatureDataset.units`.
        learnable: what of the layout is learned by gradients: any of "bins", "classes" and
            "filter", or True for all. Until it is trained, descriptions are the same.
        n_training_samples: number of samples of a body that are drawn at each step of training;
            all that are used otherwise if None. With it, the descriptor is in training mode.

    Raises:
        ValueError: no descriptor has this name, or the file is not valid, see `load`; or the
            descriptor has no such layout to learn.
    """
    check_one_of(get_args(Size), size=size)
    check_one_of(get_args(Mirror), mirror=mirror)
    if size == "auto" and units is None:
        raise ValueError(
            'size: expected "keep" or "ignore", or "auto" with the units of the bodies, got no units.'
        )
    suffixes: list[str] = []
    if isinstance(which, str):
        suffixes = _SIZE_OR_SIDE.findall(which)
        which = _SIZE_OR_SIDE.sub("", which)
    parts = layout_parts(learnable)
    base = _base_descriptor(which)
    if parts or n_training_samples is not None:
        base = with_layout(base, parts, n_training_samples)
    # Samples are drawn in training mode alone, and Lightning leaves a module in the mode in which it is given
    draws_samples = n_training_samples is not None
    if draws_samples:
        base.train()
    compares_size = size == "keep" if units is None else keeps_size(size, units)[0]
    with_size = compares_size or SIZE in suffixes
    with_side = mirror == "distinct" or SIDE in suffixes
    if with_size and isinstance(base, Measures):
        base = base.with_size().eval()
        with_size = False
    if not with_size and not with_side:
        return base
    scale = base.scale
    if isinstance(base, SizeAndSide):  # such as one that was loaded from a file
        with_size = with_size or base.keeps_size
        with_side = with_side or base.twists is not None
        base = base.descriptor
    return SizeAndSide(base, size=with_size, side=with_side, scale=scale).train(draws_samples)


def is_file(which: str | Path) -> bool:
    """Return whether an argument for a descriptor is the path of a descriptor's file or folder."""
    return str(which) not in _LIBRARY and is_descriptor_file(which)


def _base_descriptor(which: str | Path | Descriptor) -> Descriptor:
    """Return a descriptor by its name without "+size" and "+side", or by its file."""
    if isinstance(which, Descriptor):
        return which
    if is_file(which):
        return load(which)
    base, *suffixes = re.split(r"(?=\+)", str(which))
    if suffixes:
        return _with_attributes(base, suffixes)
    return _named_descriptor(base)


def _with_attributes(base: str, suffixes: Sequence[str]) -> Descriptor:
    """Return a descriptor by its name or file, with attributes by suffixes +NAME or +NAME=WEIGHT."""
    names = []
    weights = []
    for suffix in suffixes:
        match = _ATTRIBUTE.fullmatch(suffix)
        if match is None:
            raise ValueError(
                "descriptor: expected +NAME or +NAME=WEIGHT after the name of a descriptor, such "
                f"as +ct=0.5, with a weight above 0, got {base + ''.join(suffixes)!r}."
            )
        names.append(match[1])
        weights.append(float(match[2] or 1))
    return WithAttributes(_base_descriptor(base), names, weights).eval()


def _named_descriptor(name: str) -> Descriptor:
    """Return a descriptor by its name in the library or in an installed package, or by its place."""
    place = _LIBRARY.get(name) or _installed().get(name) or name
    module, colon, attribute = place.partition(":")
    if not colon:
        names = ", ".join([*_LIBRARY, *sorted(_installed())])
        raise ValueError(
            f"descriptor: expected one of {names}, or package.module:NAME of a descriptor of your "
            f"own, got {name!r}."
        )
    try:
        made_by = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"descriptor: expected package.module:NAME to be importable, got {place!r} ({error}). "
            "Check the spelling, and that the folder of the module is on the Python path."
        ) from error
    return _instance(made_by, place).eval()


def _instance(made_by: Any, place: str) -> Descriptor:
    """Return a descriptor, or the one that a class or function makes without arguments."""
    instance = made_by
    if callable(made_by) and not isinstance(made_by, Descriptor):
        try:
            instance = made_by()
        except TypeError as error:
            raise ValueError(
                f"descriptor: expected {place} to make one without arguments ({error})."
            ) from error
    if not isinstance(instance, Descriptor):
        raise ValueError(
            f"descriptor: expected {place} to be or to make an igps.Descriptor, got "
            f"{type(instance).__name__}."
        )
    return instance


def _installed() -> dict[str, str]:
    """Return the places package.module:NAME of the descriptors of other packages, by name."""
    entries = entry_points(group=ENTRY_POINTS)
    return {entry.name: f"{entry.module}:{entry.attr}" for entry in entries}
