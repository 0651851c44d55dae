"""Matrix products in full precision, whatever the settings of the process allow."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch

from igps._threads import ProcessSetting


def _enable() -> Callable[[], None]:
    """Forbid TF32 and bfloat16 in float32 products, and return a function that restores the settings.

    PyTorch has two kinds of settings: the common one of `torch.set_float32_matmul_precision`, and, since 2.9, one for
    each backend. The common one cannot be read while those of the backends contradict it.
    """
    common: str | None
    try:
        common = torch.get_float32_matmul_precision()
    except RuntimeError:
        common = None
    candidates = (torch.backends.cuda, torch.backends.mkldnn)
    backends = [x for x in candidates if hasattr(getattr(x, "matmul", None), "fp32_precision")]
    before = [(backend, _own_precision(backend)) for backend in backends]
    if common == "highest" and all(_is_full(backend) for backend in backends):
        return lambda: None
    if common is not None:
        torch.set_float32_matmul_precision("highest")
    for backend in backends:
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
    # A backend without a setting of its own reports the inherited one; restoring that would turn it into its own.
    precision = backend.matmul.fp32_precision
    inherited = getattr(backend, "fp32_precision", getattr(torch.backends, "fp32_precision", "none"))
    return "none" if precision == inherited else precision


_setting = ProcessSetting(_enable)


def full_precision() -> AbstractContextManager[None]:
    """Return a context in which float32 matrix products are computed in float32.

    `torch.set_float32_matmul_precision("medium")` and similar settings of `torch.backends` allow TF32 or bfloat16. A
    distance from inner products would then be wrong by 10⁻³ to 10⁻² of the largest, and fall into another bin.

    While any thread is inside, the settings hold for all threads of the process; the last thread that leaves restores
    them. Code traced by `torch.compile` or `torch.export` runs later, under the settings of that time.
    """
    return nullcontext() if torch.compiler.is_compiling() else _setting()
