"""Descriptors that are written down, in YAML: parts, histograms, axes, centres. Nothing runs when one is read."""

import inspect
from collections.abc import Callable, Mapping
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
"""What `histogram` may be."""

_MOST_BYTES, _MOST = 100_000, 10_000
_ABOUT = ("name", "source", "invariant_to", "scale")


def load_yaml(path: str | Path) -> HistogramDescriptor:
    """The descriptor that a YAML file specifies, in evaluation mode.

    Its `parts` are histograms, or lists of histograms, with one share each. A histogram has `axes`, each a name or a
    name with its options; `eigenpairs` of its embedding, which an axis may have of its own; `samples`, `n_samples`, and
    `histogram`, its kind, "pairs" unless given. A name that is no axis of the library is an attribute, with `centres`
    or with `quantiles`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it tells of something else, and what there is.
    """
    import yaml

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file. Check the path.")
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"expected at most {_MOST_BYTES} bytes, got {path.stat().st_size}")
        spec = yaml.safe_load(path.read_text(encoding="utf-8"))
        _only(spec, ("parts", *_ABOUT), "a descriptor")
        if not isinstance(spec.get("parts"), list):
            raise ValueError("expected a list of `parts`, got none")
        embedding = cache(lambda n: SpectralEmbedding(n_eigenpairs=n))
        parts = [
            [_histogram(each, embedding) for each in one] if isinstance(one, list) else _histogram(one, embedding)
            for one in spec["parts"]
        ]
        about = {name: spec[name] for name in ("source", "invariant_to") if name in spec}
        made = HistogramDescriptor(parts, name=str(spec.get("name", path.stem)), **about)
        made.scale = spec.get("scale")
    except (ValueError, TypeError, AttributeError, KeyError, yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: expected a descriptor ({reason}). Correct it.") from error
    return made.eval()


def _histogram(spec: Any, embedding: Callable[[int], SpectralEmbedding]) -> DescriptionPart:
    kind = str(spec.get("histogram", "pairs") if isinstance(spec, Mapping) else spec)
    if kind not in HISTOGRAMS:
        raise ValueError(f"histogram: expected one of {', '.join(HISTOGRAMS)}, got {kind!r}")
    options = {name: value for name, value in spec.items() if name != "histogram"}
    if "axes" in options:
        options["axes"] = [_axis(one, embedding) for one in options["axes"]]
    return _made(HISTOGRAMS[kind], options, embedding, kind)


def _axis(spec: Any, embedding: Callable[[int], SpectralEmbedding]) -> Any:
    name, options = next(iter(spec.items())) if isinstance(spec, Mapping) and len(spec) == 1 else (spec, {})
    if not isinstance(name, str) or not isinstance(options, Mapping | None):
        raise ValueError(f"axes: expected a name, or a name with its options, got {spec!r}")
    if name not in AXES and not {"centres", "quantiles"} & set(options or {}):
        raise ValueError(
            f"axes: expected one of {', '.join(AXES)}, or an attribute with centres or quantiles, got {name!r}"
        )
    if name in AXES:
        return _made(AXES[name], dict(options or {}), embedding, name)
    return _made(Attribute, {"name": name, **(options or {})}, embedding, name)


def _made(kind: type, options: dict[str, Any], embedding: Callable[[int], SpectralEmbedding], name: str) -> Any:
    known = [one for one in inspect.signature(kind).parameters if one != "embedding"]
    takes_embedding = len(known) < len(inspect.signature(kind).parameters)
    _only(options, (*known, *(["eigenpairs"] if takes_embedding else [])), name)
    if takes_embedding and "eigenpairs" in options:
        options["embedding"] = embedding(_number(options.pop("eigenpairs")))
    for value in options.values():
        for one in value if isinstance(value, list) else [value]:
            _number(one)
    return kind(**options)


def _number(value: Any) -> Any:
    if isinstance(value, int) and abs(value) > _MOST:
        raise ValueError(f"expected numbers of at most {_MOST}, got {value}")
    return value


def _only(spec: Any, known: tuple[str, ...], what: str) -> None:
    if not isinstance(spec, Mapping) or (unknown := [one for one in spec if one not in known]):
        raise ValueError(
            f"{what}: expected {', '.join(known)}, got {unknown[0] if isinstance(spec, Mapping) else spec!r}"
        )
