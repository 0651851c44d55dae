"""Modules that only some installations have."""

from __future__ import annotations

from typing import Any


def libigl() -> Any:
    """The module igl.

    Raises:
        ImportError: it is not installed; names the extra.
    """
    try:
        import igl
    except ImportError as error:
        raise ImportError('watertight needs libigl: pip install "interior-gps[igl]".') from error
    return igl
