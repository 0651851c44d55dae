"""Modules in files: what they were made with, in words, and their parameters; nothing runs when they are read."""

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

from igps._files import whole_file, with_ordered_metadata

_FORMAT = "igps-descriptor-1"
# Of a folder that is shared as a whole, beside its card
IN_FOLDER = "model.safetensors"
_README = """---
library_name: igps
tags: [3d, shape-descriptor]
---

# {name}

A descriptor of bodies: `igps.load("FOLDER")`, or `igps retrieve ROOT --descriptor FOLDER`. Loading runs no code.

| | |
|---|---|
{rows}"""
_CLASS = re.compile(r"igps\.(?:nn|descriptors)(?:\.[a-z0-9_]+)*\.[A-Z][A-Za-z0-9]*")
# A hostile file asks for no more: modules, a number, and numbers in a module whose size the file does not show
_MOST_MODULES, _MOST, _MOST_PARAMETERS = 200, 100_000, 1_000_000

# Whatever a damaged file raises
_UNREADABLE = (SafetensorError, OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, ImportError)


class Specified(nn.Module):
    """A module that remembers what it was made with."""

    def __new__(cls, *arguments: Any, **options: Any) -> Self:
        made = super().__new__(cls)
        made.__dict__["_made_with"] = arguments, options
        return made

    def made_with(self) -> dict[str, Any]:
        """The arguments that it was made with, by name."""
        arguments, options = self.__dict__["_made_with"]
        return inspect.signature(type(self)).bind(*arguments, **options).arguments

    def extra_repr(self) -> str:
        """Those that are numbers or words; PyTorch shows the modules."""
        return ", ".join(
            f"{name}={one!r}" for name, one in self.made_with().items() if isinstance(one, int | float | str)
        )


def specification(module: nn.Module) -> dict[str, Any]:
    """A module of the library as `class_path` and `init_args`, for JSON or YAML; parameters are not in it.

    A module that occurs again is written as `same_as`, the number of its first occurrence.

    Example:
        >>> from igps.nn.embedding import SpectralEmbedding
        >>> specification(SpectralEmbedding(n_eigenpairs=50))
        {'class_path': 'igps.nn.embedding.SpectralEmbedding', 'init_args': {'n_eigenpairs': 50}}

    Raises:
        ValueError: it, or what it was made with, is not the library's.
    """
    written: list[nn.Module] = []

    def words(value: Any) -> Any:
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, list | tuple):
            return [words(one) for one in value]
        if any(value is one for one in written):
            return {"same_as": next(i for i, one in enumerate(written) if value is one)}
        path = f"{type(value).__module__}.{type(value).__qualname__}"
        if not isinstance(value, Specified) or not _CLASS.fullmatch(path):
            raise ValueError(f"descriptor: expected to be made of modules of igps and numbers, got {path} in it.")
        written.append(value)
        return {"class_path": path, "init_args": {name: words(one) for name, one in value.made_with().items()}}

    found: dict[str, Any] = words(module)
    return found


def build_module(spec: Mapping[str, Any], n_bytes: int = 0) -> nn.Module:
    """The module of a `specification`; none is made that would need many more bytes of parameters.

    A ValueError where it specifies anything but modules of the library.
    """
    known: list[nn.Module] = []

    def module(spec: Mapping[str, Any]) -> nn.Module:
        if set(spec) == {"same_as"}:
            return known[spec["same_as"]]
        path, arguments = spec["class_path"], spec.get("init_args", {})
        if not set(spec) <= {"class_path", "init_args"} or not _CLASS.fullmatch(path) or len(known) >= _MOST_MODULES:
            raise ValueError(f"{path!r} is no module of igps, or one of too many")
        room, _, name = path.rpartition(".")
        kind = getattr(importlib.import_module(room), name, None)
        if not isinstance(kind, type) or not issubclass(kind, Specified):
            raise ValueError(f"{path} is no module of igps")
        numbers = [one for one in _numbers(arguments.values()) if one > 1]
        if max(numbers, default=0) > _MOST or ("Head" in name and math.prod(numbers) > max(_MOST_PARAMETERS, n_bytes)):
            raise ValueError(f"{name} of {numbers} is too large")
        place = len(known)
        known.append(nn.Identity())
        known[place] = kind(**{name: value(one) for name, one in arguments.items()})
        return known[place]

    def value(spec: Any) -> Any:
        if isinstance(spec, Mapping):
            return module(spec)
        return tuple(map(value, spec)) if isinstance(spec, list | tuple) else spec

    return module(spec)


def _numbers(values: Any) -> Iterator[int]:
    for one in values:
        if isinstance(one, list | tuple):
            yield from _numbers(one)
        elif isinstance(one, int):
            yield one


def save_module(module: nn.Module, path: str | Path, card: Mapping[str, Any]) -> None:
    """Write a module of the library, with its parameters and its card, to a safetensors file or a folder."""
    if Path(path).suffix != ".safetensors":
        save_module(module, path := Path(path) / IN_FOLDER, card)
        rows = (f"| {name} | `{json.dumps(value)}` |\n" for name, value in card.items())
        text = _README.format(name=getattr(module, "name", type(module).__name__), rows="".join(rows))
        path.with_name("README.md").write_text(text, encoding="utf-8")
        return
    made_with = specification(module)
    _check_as_made(module, build_module(made_with, sum(one.nbytes for one in module.state_dict().values())))
    words = {"format": _FORMAT, "specification": json.dumps(made_with), "card": json.dumps(card)}
    state = {name: value.detach().cpu().clone().contiguous() for name, value in module.state_dict().items()}
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with whole_file(Path(path)) as file:
        file.write(with_ordered_metadata(save(state, metadata=words)))


def _check_as_made(module: nn.Module, made: nn.Module) -> None:
    """Raise a ValueError where a module was changed in a way that no file keeps: it would come back as another."""
    parts = dict(made.named_modules())
    for place, one in module.named_modules():
        other, changed = parts.get(place), [""]
        if type(other) is type(one):
            plain = {name: value for name, value in vars(other).items() if _is_plain(name, value)}
            changed = [name for name, value in plain.items() if getattr(one, name, value) != value]
        if changed:
            what = ".".join(filter(None, (place, changed[0])))
            raise ValueError(f"{what}: expected as it was made, got a changed one, which no file keeps. Make it anew.")


def _is_plain(name: str, value: Any) -> bool:
    return not name.startswith("_") and name != "training" and isinstance(value, bool | int | float | str | tuple)


def load_module(path: str | Path) -> tuple[nn.Module, dict[str, Any]]:
    """The module that `save_module` wrote, in evaluation mode, and its card. No code of the file runs.

    A FileNotFoundError without a file, a ValueError if it is none of these, or damaged.
    """
    path = Path(path)
    path = path / IN_FOLDER if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file. Check the path.")
    try:
        with safe_open(path, framework="pt") as file:
            words = file.metadata() or {}
            if words.get("format") != _FORMAT:
                raise ValueError(f"its format is {words.get('format')!r}")
            module = build_module(json.loads(words["specification"]), path.stat().st_size)
            module.load_state_dict({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
        if not all(bool(torch.isfinite(one).all()) for one in module.state_dict().values()):
            raise ValueError("a parameter is not finite")
        card = json.loads(words["card"])
        if not isinstance(card, dict):
            raise ValueError("its card is no table")
    except _UNREADABLE as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path}: expected a descriptor in the format {_FORMAT} ({reason}). Save it again.") from error
    return module.eval(), card
