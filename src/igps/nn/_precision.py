"""Matrix products whose rounding no setting of the process may coarsen."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch

from igps._threads import ProcessSetting


def _change() -> Callable[[], None]:
    """Allow no TF32 or bfloat16 in float32 products; what restores the settings as they were.

    PyTorch keeps them twice: as `torch.set_float32_matmul_precision` leaves them, and, from 2.9 on, for each backend.
    The first cannot be read where the second contradicts it.
    """
    common: str | None
    try:
        common = torch.get_float32_matmul_precision()
    except RuntimeError:
        common = None
    backends = (torch.backends.cuda, torch.backends.mkldnn)
    known = [one for one in backends if hasattr(getattr(one, "matmul", None), "fp32_precision")]
    before = [(backend, _own_precision(backend)) for backend in known]
    if common == "highest" and all(_is_full(backend) for backend in known):
        return lambda: None
    if common is not None:
        torch.set_float32_matmul_precision("highest")
    for backend in known:
        if not _is_full(backend):
            backend.matmul.fp32_precision = "ieee"

    def restore() -> None:
        if common is not None:
            torch.set_float32_matmul_precision(common)
        for backend, precision in before:
            if _own_precision(backend) != precision:
                backend.matmul.fp32_precision = precision

    return restore


def _is_full(backend: Any) -> bool:
    return backend.matmul.fp32_precision in ("none", "ieee")


def _own_precision(backend: Any) -> str:
    # It reads as that of the backend, or of all backends, where it has none of its own, and must have none again.
    precision = backend.matmul.fp32_precision
    of_all = getattr(torch.backends, "fp32_precision", "none")
    return "none" if precision == getattr(backend, "fp32_precision", of_all) else precision


_setting = ProcessSetting(_change)


def full_precision() -> AbstractContextManager[None]:
    """A context in which float32 matrix products are computed in float32.

    `torch.set_float32_matmul_precision("medium")`, and the settings of `torch.backends` like it, allow TF32 or
    bfloat16: a distance from inner products would be wrong by 10⁻³ to 10⁻² of the largest, and fall into another bin.
    The settings belong to the process: while a thread is inside, they hold for all threads; when the last one leaves,
    they are restored. What PyTorch traces for `torch.compile` or `torch.export` runs later, under the settings of then.
    """
    return nullcontext() if torch.compiler.is_compiling() else _setting()
