"""What tells descriptors apart: a checksum of their parameters, and a tag of all that their descriptions depend on."""

import hashlib
import importlib.metadata
import json
from functools import cache
from pathlib import Path
from typing import Any

from torch import nn

from igps.descriptors.registry import is_file
from igps.nn.descriptor import Descriptor
from igps.nn.specification import specification

# The packages that descriptions are computed with.
_COMPUTE_WITH = "torch", "numpy", "scipy", "numba", "libigl"


def name_of(descriptor: str | Path | Descriptor) -> str:
    """The name by which a descriptor was asked for, of a file its whole path; or the descriptor's own."""
    if isinstance(descriptor, Descriptor):
        return descriptor.name
    return str(Path(descriptor).resolve()) if is_file(descriptor) else str(descriptor)


def fingerprint(descriptor: nn.Module) -> str:
    """A checksum of all parameters of a descriptor: numbers, learned or given, and classes of all its modules."""
    found = hashlib.sha256()
    of_every_module = vars(nn.Module())  # differ between versions of PyTorch
    for name, module in descriptor.named_modules():
        plain = {k: v for k, v in sorted(vars(module).items()) if k not in of_every_module and _is_plain(v)}
        found.update(f"{name} {type(module).__qualname__} {plain!r}\0".encode())
    for name, tensor in sorted(descriptor.state_dict().items()):
        values = tensor.detach().cpu().contiguous()
        found.update(f"{name} {values.dtype} {tuple(values.shape)}\0".encode())
        found.update(values.numpy().tobytes())
    return found.hexdigest()[:32]


def cache_tag(module: nn.Module) -> str | None:
    """All that descriptions depend on beside Signatures, in words, see `igps.nn.description.describe`.

    What the descriptor is made of, its parameters, the library's code, and the versions of what that computes with.
    None for a descriptor that holds anything of others, whose code is not known, such as a hook.
    """
    if any(one._forward_hooks or one._forward_pre_hooks for one in module.modules()):
        return None
    try:
        made_of = json.dumps(specification(module))
    except ValueError:
        return None
    return f"{hashlib.sha256(made_of.encode()).hexdigest()[:32]} {fingerprint(module)} {_code()}"


@cache
def _code() -> str:
    """A checksum of the library's sources, and versions."""
    package = Path(__file__).parents[1]
    found = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        found.update(f"{source.relative_to(package).as_posix()}\0".encode())
        found.update(source.read_bytes())
    return " ".join((found.hexdigest()[:32], *(f"{name} {importlib.metadata.version(name)}" for name in _COMPUTE_WITH)))


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, bool | int | float | str)
