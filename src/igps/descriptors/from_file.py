"""Descriptors from files and folders. Loading runs no code of a file."""

import math
import os
from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from itertools import islice
from pathlib import Path
from typing import Any, ParamSpec

import torch
from torch import nn

from igps.nn.descriptor import NAME, Descriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads import ClassifierHead, Head
from igps.nn.specification import IN_FOLDER, build_module, load_module

Parameters = ParamSpec("Parameters")

_YAML = (".yaml", ".yml")
# Limits of a YAML file, which may come from strangers: its size, and the values in it, which aliases can multiply
_MAX_BYTES = 100_000
_MAX_VALUES = 10_000
# What a specification can raise that is none, or names what is not there
_UNREADABLE = (ValueError, TypeError, AttributeError, LookupError, ImportError, RecursionError)


def is_descriptor_file(path: str | Path) -> bool:
    """Return whether a path is that of a descriptor's file by its suffix, or of its folder."""
    is_named_so = str(path).lower().endswith((".safetensors", *_YAML))
    # os.path, as it accepts any text: no descriptor's folder has an invalid path
    is_folder = bool(path) and os.path.isfile(os.path.join(path, IN_FOLDER))
    return is_named_so or is_folder


def with_values(make: Callable[Parameters, Descriptor]) -> Callable[Parameters, Descriptor]:
    """Let a function make its descriptor on the CPU if the default device is "meta", without values to check.

    A descriptor among its arguments stays where it is.
    """

    @wraps(make)
    def made(*arguments: Parameters.args, **options: Parameters.kwargs) -> Descriptor:
        if torch.get_default_device().type != "meta":
            return make(*arguments, **options)
        with torch.device("cpu"):
            descriptor = make(*arguments, **options)
        is_given = any(isinstance(x, Descriptor) for x in (*arguments, *options.values()))
        return descriptor if is_given else descriptor.to("meta")

    return made


@with_values
def load(path: str | Path) -> Descriptor:
    """Load a descriptor from a file or folder, in evaluation mode, with its `card`. No code from the file runs.

    The file was written by `Descriptor.save` or `igps fit`; or it is YAML, with the `class_path` of each module and its
    `init_args`, see `igps.nn.specification.specification`.

    Example:
        >>> import tempfile
        >>> from igps import descriptor
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     descriptor("interior").save(f"{folder}/mine.safetensors", {"author": "me"})
        ...     loaded = load(f"{folder}/mine.safetensors")
        >>> loaded.name, dict(loaded.card)
        ('interior', {'author': 'me'})

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, or does not hold a descriptor.
    """
    if str(path).lower().endswith(_YAML):
        module = _written_module(Path(path))
        card: dict[str, Any] = {}
    else:
        module, card = load_module(path)
    if not isinstance(module, Descriptor):
        raise ValueError(f"{path}: expected a descriptor, got {type(module).__name__}.")
    if not NAME.fullmatch(module.name):
        raise ValueError(
            f"{path}: expected a descriptor's name of letters, digits and _, "
            f"got {module.name[:80]!r}."
        )
    for submodule in module.modules():
        if isinstance(submodule, EmbeddedDescriptor):
            _check_head(submodule.descriptor, submodule.head, path)
    module.card = card
    scale = card.get("scale")  # cards may come from users: this entry may be anything
    if isinstance(scale, int | float) and 0 < scale < math.inf:
        module.scale = scale
    return module


def _written_module(path: Path) -> nn.Module:
    """Return the module that a YAML file specifies, in evaluation mode."""
    import yaml

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file. Check the path.")
    try:
        n_bytes = path.stat().st_size
        if n_bytes > _MAX_BYTES:
            raise ValueError(f"expected at most {_MAX_BYTES} bytes, got {n_bytes}")
        spec = yaml.safe_load(path.read_text(encoding="utf-8"))
        if any(True for _ in islice(_values(spec), _MAX_VALUES, None)):
            raise ValueError(f"expected at most {_MAX_VALUES} values, got more")
        module = build_module(spec)
    except (*_UNREADABLE, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: expected a descriptor ({reason}). Correct it.") from error
    return module.eval()


def _values(value: Any) -> Iterator[Any]:
    """Yield a value and all values in it."""
    yield value
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list):
        for inner in value:
            yield from _values(inner)


def _check_head(descriptor: Descriptor, head: Head, path: str | Path) -> None:
    """Raise a ValueError if the sizes of a head's tensors are inconsistent, before any body is described."""
    if not isinstance(descriptor, HistogramDescriptor):
        return
    cells = torch.ones(2, descriptor.n_features)
    try:
        head(cells)
        if isinstance(head, ClassifierHead):
            head.strangeness(cells)
    except (ValueError, RuntimeError, TypeError, LookupError, ArithmeticError) as error:
        raise ValueError(
            f"{path}: expected a head for {cells.shape[1]} cells ({error}). Save it again."
        ) from error
