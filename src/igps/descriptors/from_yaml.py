"""Histogram descriptors that are specified in YAML. Reading such a file runs no code from it."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from igps.descriptors.pretrained.axial_histogram import AxialHistogram
from igps.descriptors.pretrained.branch_histogram import BranchHistogram
from igps.descriptors.pretrained.piece_histogram import PieceHistogram
from igps.descriptors.pretrained.spectrum_shares import SpectrumShares
from igps.nn.axes import AXES, Attribute
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.base import DescriptionPart
from igps.nn.histograms.pairs import PairHistogram
from igps.nn.histograms.points import PointHistogram

HISTOGRAMS: Mapping[str, type[DescriptionPart]] = {
    "pairs": PairHistogram,
    "points": PointHistogram,
    "axial": AxialHistogram,
    "branches": BranchHistogram,
    "pieces": PieceHistogram,
    "spectrum": SpectrumShares,
}
"""Classes of histograms by their names in YAML files."""

_MAX_BYTES = 100_000  # of a file
# Of any number in a file: files are untrusted, and must not ask for huge histograms
_MAX_INTEGER = 10_000


def load_yaml(path: str | Path) -> HistogramDescriptor:
    """Load the descriptor that a YAML file specifies, in evaluation mode.

    The key `parts` lists histograms, or lists of histograms; each part has the same share of a description. A histogram
    has the key `histogram`, its kind ("pairs" by default), and the arguments of its class, such as `axes`, `samples`
    and `n_samples`. In place of the argument `embedding`, the key `eigenpairs` is a number of eigenpairs; an axis may
    have its own. An axis is a name, or a name with options. A name that is not among the library's axes is that of an
    attribute, with the option `centres` or `quantiles`. Optional keys of the descriptor are `name`, `source`,
    `invariant_to` and `scale`, see `Descriptor`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not such a specification; the message says what was expected.
    """
    import yaml

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file. Check the path.")
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError(f"expected at most {_MAX_BYTES} bytes, got {path.stat().st_size}")
        spec = yaml.safe_load(path.read_text(encoding="utf-8"))
        _check_keys(spec, ("parts", "name", "source", "invariant_to", "scale"), "a descriptor")
        if not isinstance(spec.get("parts"), list):
            raise ValueError("expected a list of `parts`, got none")
        embedding = cache(lambda n: SpectralEmbedding(n_eigenpairs=n))
        parts = [
            [_histogram(item, embedding) for item in part]
            if isinstance(part, list)
            else _histogram(part, embedding)
            for part in spec["parts"]
        ]
        metadata = {key: spec[key] for key in ("source", "invariant_to") if key in spec}
        descriptor = HistogramDescriptor(parts, name=str(spec.get("name", path.stem)), **metadata)
        descriptor.scale = spec.get("scale")
    except (
        ValueError,
        TypeError,
        AttributeError,
        KeyError,
        yaml.YAMLError,
        RecursionError,
    ) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: expected a descriptor ({reason}). Correct it.") from error
    return descriptor.eval()


def _histogram(spec: Any, embedding: Callable[[int], SpectralEmbedding]) -> DescriptionPart:
    kind = str(spec.get("histogram", "pairs") if isinstance(spec, Mapping) else spec)
    if kind not in HISTOGRAMS:
        raise ValueError(f"histogram: expected one of {', '.join(HISTOGRAMS)}, got {kind!r}")
    options = {name: value for name, value in spec.items() if name != "histogram"}
    if "axes" in options:
        options["axes"] = [_axis(axis, embedding) for axis in options["axes"]]
    return _build(HISTOGRAMS[kind], options, embedding, kind)


def _axis(spec: Any, embedding: Callable[[int], SpectralEmbedding]) -> Any:
    name, options = (
        next(iter(spec.items())) if isinstance(spec, Mapping) and len(spec) == 1 else (spec, {})
    )
    if not isinstance(name, str) or not isinstance(options, Mapping | None):
        raise ValueError(f"axes: expected a name, or a name with its options, got {spec!r}")
    options = dict(options or {})
    if name in AXES:
        return _build(AXES[name], options, embedding, name)
    if not {"centres", "quantiles"} & set(options):
        raise ValueError(
            f"axes: expected one of {', '.join(AXES)}, or an attribute with centres or quantiles, got {name!r}"
        )
    return _build(Attribute, {"name": name, **options}, embedding, name)


def _build(
    kind: type, options: dict[str, Any], embedding: Callable[[int], SpectralEmbedding], name: str
) -> Any:
    """Check the options of a class, which messages call `name`, and make an instance of it."""
    parameters = inspect.signature(kind).parameters
    keys = [key for key in parameters if key != "embedding"] + ["eigenpairs"] * (
        "embedding" in parameters
    )
    _check_keys(options, keys, name)
    for value in options.values():
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, int) and abs(number) > _MAX_INTEGER:
                raise ValueError(f"expected numbers of at most {_MAX_INTEGER}, got {number}")
    if "eigenpairs" in options:
        options["embedding"] = embedding(options.pop("eigenpairs"))
    return kind(**options)


def _check_keys(spec: Any, known: Sequence[str], name: str) -> None:
    if not isinstance(spec, Mapping) or (unknown := [key for key in spec if key not in known]):
        raise ValueError(
            f"{name}: expected {', '.join(known)}, got {unknown[0] if isinstance(spec, Mapping) else spec!r}"
        )
