"""Identity of descriptors: a checksum of the parameters, and a tag of everything that descriptions depend on."""

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

# Packages whose versions may change the digits of descriptions.
_NUMERICAL_PACKAGES = "torch", "numpy", "scipy", "numba", "libigl"


def name_of(descriptor: str | Path | Descriptor) -> str:
    """Return the name that identifies a descriptor: its registry name, the absolute path of its file, or its `name`."""
    if isinstance(descriptor, Descriptor):
        return descriptor.name
    return str(Path(descriptor).resolve()) if is_file(descriptor) else str(descriptor)


def fingerprint(descriptor: nn.Module) -> str:
    """Return a checksum of a descriptor: of its saved tensors, and of classes and plain attributes of its modules."""
    checksum = hashlib.sha256()
    # Attributes of every module; they differ between versions of PyTorch
    common = vars(nn.Module())
    for name, module in descriptor.named_modules():
        own = {key: value for key, value in sorted(vars(module).items()) if key not in common}
        plain = {key: value for key, value in own.items() if _is_plain(value)}
        checksum.update(f"{name} {type(module).__qualname__} {plain!r}\0".encode())
    for name, tensor in sorted(descriptor.state_dict().items()):
        values = tensor.detach().cpu().contiguous()
        checksum.update(f"{name} {values.dtype} {tuple(values.shape)}\0".encode())
        checksum.update(values.numpy().tobytes())
    return checksum.hexdigest()[:32]


def cache_tag(module: nn.Module) -> str | None:
    """Return a tag of everything but the Signatures that descriptions depend on, see `igps.nn.description.describe`.

    The tag consists of checksums of the descriptor's specification, of its parameters and of the library's code, and
    of the versions of the numerical packages. It is None for a descriptor with code from outside the library, such as a
    forward hook or a module of another package.
    """
    for submodule in module.modules():
        if submodule._forward_hooks or submodule._forward_pre_hooks:
            return None
    try:
        spec = json.dumps(specification(module))
    except ValueError:
        return None
    checksum = hashlib.sha256(spec.encode()).hexdigest()[:32]
    return f"{checksum} {fingerprint(module)} {_code_tag()}"


@cache
def _code_tag() -> str:
    """A checksum of the library's source files, and the versions of the numerical packages."""
    package = Path(__file__).parents[1]
    checksum = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        checksum.update(f"{source.relative_to(package).as_posix()}\0".encode())
        checksum.update(source.read_bytes())
    versions = (f"{name} {importlib.metadata.version(name)}" for name in _NUMERICAL_PACKAGES)
    return " ".join((checksum.hexdigest()[:32], *versions))


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, bool | int | float | str)
