"""Matrix products whose rounding no setting of the process may coarsen."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch

from igps._threads import ProcessSetting


class _Settings:
    """What decides whether float32 products may be computed in TF32 or bfloat16, as it was when this was made.

    PyTorch keeps it twice: as `torch.set_float32_matmul_precision` leaves it, and, from 2.9 on, for each backend. The
    first cannot be read where the second contradicts it.
    """

    def __init__(self) -> None:
        self.common: str | None
        try:
            self.common = torch.get_float32_matmul_precision()
        except RuntimeError:
            self.common = None
        self.by_backend = [(backend, _own_precision(backend)) for backend in _backends()]

    @property
    def is_full(self) -> bool:
        return self.common == "highest" and all(_is_full(backend) for backend in _backends())

    def make_full(self) -> None:
        if self.common is not None:
            torch.set_float32_matmul_precision("highest")
        for backend in _backends():
            if not _is_full(backend):
                backend.matmul.fp32_precision = "ieee"

    def restore(self) -> None:
        if self.common is not None:
            torch.set_float32_matmul_precision(self.common)
        for backend, precision in self.by_backend:
            if _own_precision(backend) != precision:
                backend.matmul.fp32_precision = precision


def _backends() -> list[Any]:
    return [
        backend
        for backend in (torch.backends.cuda, torch.backends.mkldnn)
        if hasattr(getattr(backend, "matmul", None), "fp32_precision")
    ]


def _common_precision() -> str:
    # Of all backends, where one has none for all that it does.
    return getattr(torch.backends, "fp32_precision", "none")


def _is_full(backend: Any) -> bool:
    return backend.matmul.fp32_precision in ("none", "ieee")


def _own_precision(backend: Any) -> str:
    # It reads as that of the backend, or of all, where it has none of its own, and must have none again.
    precision = backend.matmul.fp32_precision
    return "none" if precision == getattr(backend, "fp32_precision", _common_precision()) else precision


def _change() -> Callable[[], None]:
    settings = _Settings()
    if settings.is_full:
        return lambda: None
    settings.make_full()
    return settings.restore


_setting = ProcessSetting(_change)


def full_precision() -> AbstractContextManager[None]:
    """A context in which float32 matrix products are computed in float32.

    `torch.set_float32_matmul_precision("medium")`, and the settings of `torch.backends` like it, allow TF32 or
    bfloat16: a distance from inner products would be wrong by 10⁻³ to 10⁻² of the largest, and fall into another bin.
    The settings belong to the process: while a thread is inside, they hold for all threads; when the last one leaves,
    they are restored. What PyTorch traces for `torch.compile` or `torch.export` runs later, under the settings of then.
    """
    return nullcontext() if torch.compiler.is_compiling() else _setting()
