"""Modules that only some installations have."""

from __future__ import annotations

from typing import Any


def libigl(who: str = "watertight") -> Any:
    """The module igl.

    Args:
        who: needs it.

    Raises:
        ImportError: it is not installed; names the extra.
    """
    try:
        import igl
    except ImportError as error:
        raise ImportError(f'{who} needs libigl: pip install "interior-gps[igl]".') from error
    return igl
