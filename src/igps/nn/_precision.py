"""Matrix products in full precision, independent of the settings of the process."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Any

import torch

from igps._threads import ProcessSetting


def _enable_full_precision() -> Callable[[], None]:
    """Forbid TF32 and bfloat16 in float32 products, and return a function that restores the settings.

    PyTorch has a common setting, `torch.set_float32_matmul_precision`, and since 2.9 one for each backend. The common
    setting cannot be read while a backend's setting contradicts it.
    """
    common = None
    with suppress(RuntimeError):
        common = torch.get_float32_matmul_precision()
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
    # A backend without its own setting reports the inherited setting; restoring this would make it the backend's own.
    precision = backend.matmul.fp32_precision
    inherited = getattr(
        backend, "fp32_precision", getattr(torch.backends, "fp32_precision", "none")
    )
    return "none" if precision == inherited else precision


_setting = ProcessSetting(_enable_full_precision)


def full_precision() -> AbstractContextManager[None]:
    """Return a context in which float32 matrix products are computed in float32.

    `torch.set_float32_matmul_precision("medium")` and similar settings of `torch.backends` allow TF32 or bfloat16.
    Distances from inner products would then be wrong by 10⁻³ to 10⁻² of the largest, and fall into other bins.

    While any thread is inside, full precision holds for all threads of the process; the last thread that leaves
    restores the settings. Code traced by `torch.compile` or `torch.export` runs later, under the settings of that time.
    """
    return nullcontext() if torch.compiler.is_compiling() else _setting()
