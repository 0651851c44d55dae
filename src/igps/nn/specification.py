"""Saving and loading of modules: constructor arguments as JSON, and parameters. Loading a file runs no code of it."""

import importlib
import inspect
import json
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn
from torch.nn.modules.lazy import LazyModuleMixin
from torch.nn.parameter import is_lazy

from igps._files import atomic_write, sort_metadata

_FORMAT = "igps-descriptor-1"
IN_FOLDER = "model.safetensors"  # file name in a folder, beside the card README.md
_README = """---
library_name: igps
tags: [3d, shape-descriptor]
---

# {name}

A descriptor of bodies: `igps.load("FOLDER")`, or `igps retrieve ROOT --descriptor FOLDER`. Loading runs no code.

| | |
|---|---|
{rows}"""
_CLASS = re.compile(r"igps\.(?:nn|descriptors|fields)(?:\.[a-z0-9_]+)*\.[A-Z][A-Za-z0-9]*")
# Limits on what a hostile file can allocate: the number of modules, the largest argument, and the product of the
# arguments of a head, whose memory can exceed the size of the file.
_MAX_MODULES, _MAX_NUMBER, _MAX_PARAMETERS = 200, 100_000, 1_000_000
# Errors that a damaged file can raise.
_UNREADABLE = (
    SafetensorError,
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    RuntimeError,
    ImportError,
)


class Specified(nn.Module):
    """A module that remembers its constructor arguments."""

    def __new__(cls, *arguments: Any, **options: Any) -> Self:
        module = super().__new__(cls)
        module.__dict__["_made_with"] = arguments, options
        return module

    def made_with(self) -> dict[str, Any]:
        """Return the constructor arguments that were given, by name."""
        arguments, options = self.__dict__["_made_with"]
        return inspect.signature(type(self)).bind(*arguments, **options).arguments

    def extra_repr(self) -> str:
        """Return the arguments that are numbers or strings, for `repr`; PyTorch adds the submodules."""
        shown = []
        for name, value in self.made_with().items():
            if isinstance(value, int | float | str):
                shown.append(f"{name}={value!r}")
        return ", ".join(shown)


def specification(module: nn.Module) -> dict[str, Any]:
    """Return a module of the library as `class_path` and `init_args`, for JSON or YAML, without its parameters.

    A module that occurs again is written as `same_as`, with the position of the module in the order of occurrence.

    Example:
        >>> from igps.nn.embedding import SpectralEmbedding
        >>> specification(SpectralEmbedding(n_eigenpairs=50))
        {'class_path': 'igps.nn.embedding.SpectralEmbedding', 'init_args': {'n_eigenpairs': 50}}

    Raises:
        ValueError: the module, or a module among its arguments, does not belong to the library.
    """
    modules: list[nn.Module] = []

    def encode(value: Any) -> Any:
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, list | tuple):
            return [encode(x) for x in value]
        for position, known in enumerate(modules):
            if value is known:
                return {"same_as": position}
        path = f"{type(value).__module__}.{type(value).__qualname__}"
        if not isinstance(value, Specified) or not _CLASS.fullmatch(path):
            raise ValueError(
                f"descriptor: expected to be made of modules of igps and numbers, got {path} in it."
            )
        modules.append(value)
        arguments = {name: encode(x) for name, x in value.made_with().items()}
        return {"class_path": path, "init_args": arguments}

    encoded: dict[str, Any] = encode(module)
    return encoded


def build_module(spec: Mapping[str, Any], n_bytes: int = 0) -> nn.Module:
    """Build the module of a `specification`, whose saved parameters take `n_bytes` bytes.

    Raises:
        ValueError: the specification contains other things than modules of the library, or a module that is too large.
    """
    modules: list[nn.Module] = []

    def build(spec: Mapping[str, Any]) -> nn.Module:
        if not isinstance(spec, Mapping) or not {"class_path", "same_as"} & set(spec):
            raise ValueError("a descriptor has the keys class_path and init_args")
        if set(spec) == {"same_as"}:
            return modules[spec["same_as"]]
        path = spec["class_path"]
        arguments = spec.get("init_args", {})
        is_module = set(spec) <= {"class_path", "init_args"} and _CLASS.fullmatch(path)
        if not is_module or len(modules) >= _MAX_MODULES:
            raise ValueError(
                f"{path!r} is no module of igps, or there are more than {_MAX_MODULES} modules"
            )
        package, _, name = path.rpartition(".")
        cls = getattr(importlib.import_module(package), name, None)
        if not isinstance(cls, type) or not issubclass(cls, Specified):
            raise ValueError(f"{path} is no module of igps")
        sizes = [n for n in _integers(arguments.values()) if n > 1]
        max_parameters = max(_MAX_PARAMETERS, n_bytes) if "Head" in name else math.inf
        if max(sizes, default=0) > _MAX_NUMBER or math.prod(sizes) > max_parameters:
            raise ValueError(f"{name} of {sizes} is too large")
        position = len(modules)
        # Placeholder, as the arguments may contain modules with later positions
        modules.append(nn.Identity())
        decoded = {name: decode(x) for name, x in arguments.items()}
        modules[position] = cls(**decoded)
        return modules[position]

    def decode(value: Any) -> Any:
        if isinstance(value, Mapping):
            return build(value)
        if isinstance(value, list | tuple):
            return tuple(map(decode, value))
        return value

    return build(spec)


def _integers(values: Any) -> Iterator[int]:
    for value in values:
        if isinstance(value, list | tuple):
            yield from _integers(value)
        elif isinstance(value, int):
            yield value


def save_module(module: nn.Module, path: str | Path, card: Mapping[str, Any]) -> None:
    """Write a module of the library, its parameters and its card to a safetensors file or a folder."""
    path = Path(path)
    if path.suffix != ".safetensors":
        save_module(module, path / IN_FOLDER, card)
        name = getattr(module, "name", type(module).__name__)
        rows = [f"| {fact} | `{json.dumps(value)}` |\n" for fact, value in card.items()]
        text = _README.format(name=name, rows="".join(rows))
        (path / "README.md").write_text(text, encoding="utf-8")
        return
    if any(map(is_lazy, module.parameters())):
        raise ValueError(
            "descriptor: expected layers that have a size, got a head that was never called. "
            "Train it, or call it with descriptions, before it is saved."
        )
    spec = specification(module)
    state = {
        name: value.detach().cpu().clone().contiguous()
        for name, value in module.state_dict().items()
    }
    n_bytes = sum(tensor.nbytes for tensor in state.values())
    _check_unchanged(module, build_module(spec, n_bytes))
    metadata = {"format": _FORMAT, "specification": json.dumps(spec), "card": json.dumps(card)}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        file.write(sort_metadata(save(state, metadata=metadata)))


def _check_unchanged(module: nn.Module, rebuilt: nn.Module) -> None:
    """Raise a ValueError if an attribute was changed after construction, as a file would not preserve the change."""
    rebuilt_modules = dict(rebuilt.named_modules())
    for path, submodule in module.named_modules():
        original = rebuilt_modules.get(path)
        if isinstance(original, LazyModuleMixin):
            continue  # The class of the original changes in its first call
        changed = _changed_attribute(original, submodule)
        if changed is not None:
            name = ".".join(filter(None, (path, changed)))
            raise ValueError(
                f"{name}: expected its initial value, got another, which is not saved. Make a new module."
            )


def _changed_attribute(original: nn.Module | None, module: nn.Module) -> str | None:
    """Return the first public attribute with another value than in the original, "" if the classes differ, or None."""
    if type(original) is not type(module):
        return ""
    for name, value in vars(original).items():
        is_public = name[0] != "_" and name != "training"
        is_plain = isinstance(value, int | float | str | tuple)
        if is_public and is_plain and getattr(module, name, value) != value:
            return name
    return None


def load_module(path: str | Path) -> tuple[nn.Module, dict[str, Any]]:
    """Load a module that `save_module` wrote, in evaluation mode, and its card. No code of the file runs.

    Raises a FileNotFoundError for a missing file, and a ValueError for a damaged file or another format.
    """
    path = Path(path)
    if path.is_dir():
        path = path / IN_FOLDER
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file. Check the path.")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != _FORMAT:
                raise ValueError(f"its format is {metadata.get('format')!r}")
            module = build_module(json.loads(metadata["specification"]), path.stat().st_size)
            module.load_state_dict({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
        for tensor in module.state_dict().values():
            if not bool(torch.isfinite(tensor).all()):
                raise ValueError("a parameter is not finite")
        card = json.loads(metadata["card"])
        if not isinstance(card, dict):
            raise ValueError("its card is not a mapping")
    except _UNREADABLE as error:
        lines = str(error).splitlines()
        reason = lines[0] if lines else type(error).__name__
        raise ValueError(
            f"{path}: expected a descriptor in the format {_FORMAT} ({reason}). Save it again."
        ) from error
    return module.eval(), card
