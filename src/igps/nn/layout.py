"""Descriptors whose layout is learned: the centres of bins and classes, and the spectral filter."""

import copy
import inspect
from collections.abc import Collection
from typing import Any, Literal, TypeVar, get_args

from torch import nn

from igps._parameters import check_one_of
from igps.nn.axes import PairAxis, PointAxis
from igps.nn.descriptor import Descriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.heads.base import Head
from igps.nn.histograms.base import AxesHistogram, SampleHistogram
from igps.nn.specification import Specified

LayoutPart = Literal["bins", "classes", "filter"]
Module = TypeVar("Module", bound=nn.Module)

_N_KNOTS = 12  # of a learned filter


def layout_parts(learnable: bool | Collection[LayoutPart]) -> frozenset[LayoutPart]:
    """Return the parts of a layout that are learned: all for True, none for False."""
    if isinstance(learnable, bool):
        return frozenset(get_args(LayoutPart) if learnable else ())
    for part in learnable:
        check_one_of(get_args(LayoutPart), learnable=part)
    return frozenset(learnable)


def with_layout(
    descriptor: Descriptor,
    learnable: Collection[LayoutPart] = (),
    n_training_samples: int | None = None,
) -> Descriptor:
    """Return a copy of a descriptor of histograms whose layout has parameters.

    Descriptions are those of the descriptor until the parameters are trained. Other parts of the
    description, such as lengths of limbs, and a head stay as they are.

    Args:
        descriptor: of one or several histograms, with or without a head.
        learnable: "bins" for the centres of bins, "classes" for those of classes, "filter" for a
            spectral filter for each embedding.
        n_training_samples: of each histogram, see `SampleHistogram`; None keeps their numbers.

    Raises:
        ValueError: the descriptor has no layout of this kind.
    """
    n_before = sum(1 for _ in descriptor.parameters())
    copied: Descriptor = _Copying(frozenset(learnable), n_training_samples).copy(descriptor)
    if learnable and sum(1 for _ in copied.parameters()) == n_before:
        raise ValueError(
            f"learnable: expected a descriptor whose histograms have {' or '.join(learnable)} to "
            f"learn, such as interior, got {descriptor.name!r}. Leave out learnable."
        )
    copied.card = descriptor.card
    copied.scale = descriptor.scale
    return copied.train(descriptor.training)


class _Copying:
    """Makes each module again with other arguments; a module that occurs twice is copied once."""

    def __init__(self, parts: frozenset[LayoutPart], n_training_samples: int | None) -> None:
        self._parts = parts
        self._n_training_samples = n_training_samples
        self._copies: dict[nn.Module, nn.Module] = {}

    def copy(self, module: Module) -> Module:
        if module not in self._copies:
            self._copies[module] = self._new(module)
        copied = self._copies[module]
        assert isinstance(copied, type(module))
        return copied

    def _new(self, module: nn.Module) -> nn.Module:
        if not isinstance(module, Specified) or isinstance(module, Head):
            return copy.deepcopy(module)
        arguments = module.made_with()
        if isinstance(module, SampleHistogram) and "embedding" in _options(module):
            arguments["embedding"] = module.embedding
        if isinstance(module, AxesHistogram):
            arguments["axes"] = list(module.axes)
        arguments = {name: self._argument(value) for name, value in arguments.items()}
        arguments |= self._changes(module)
        changed = type(module)(**arguments)
        changed.load_state_dict(module.state_dict(), strict=False)
        return changed

    def _argument(self, value: Any) -> Any:
        if isinstance(value, list | tuple):
            return [self._argument(item) for item in value]
        return self.copy(value) if isinstance(value, nn.Module) else value

    def _changes(self, module: Specified) -> dict[str, Any]:
        """Return the arguments by which a module differs from its copy."""
        if isinstance(module, SpectralEmbedding):
            is_new = "filter" in self._parts and module.log_gain is None
            return {"n_knots": _N_KNOTS} if is_new else {}
        changes: dict[str, Any] = {}
        if isinstance(module, SampleHistogram) and self._n_training_samples is not None:
            changes["n_training_samples"] = self._n_training_samples
        part = "classes" if isinstance(module, PointAxis) else "bins"
        has_layout = isinstance(module, PointAxis | PairAxis | SampleHistogram)
        if has_layout and part in self._parts and "learnable" in _options(module):
            changes["learnable"] = True
        return changes


def _options(module: nn.Module) -> Collection[str]:
    """Return the names of the arguments by which a module is made."""
    return inspect.signature(type(module)).parameters
