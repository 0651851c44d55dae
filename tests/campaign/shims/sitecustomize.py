"""Simulated faults of the machine, in every Python process that has this folder on its path.

The environment variable IGPS_CAMPAIGN_FAULT is one of
    full N     the disk is full: the files of the cache hold at most N bytes in total;
    rename     a file cannot be renamed over another file, as if that file were open in another process;
    clock S    the clock is S seconds behind.
"""

from __future__ import annotations

import os
import time

_NAME, _, _VALUE = os.environ.get("IGPS_CAMPAIGN_FAULT", "").partition(" ")


def _no_rename() -> None:
    replace = os.replace
    rename = os.rename

    def refusing(move):  # type: ignore[no-untyped-def]
        def moved(source, target, **options):  # type: ignore[no-untyped-def]
            if os.path.exists(target) and str(target).endswith(".safetensors"):
                raise PermissionError(
                    13, "The process cannot access the file because it is used by another", target
                )
            return move(source, target, **options)

        return moved

    os.replace = refusing(replace)
    os.rename = refusing(rename)


def _no_space(limit: int) -> None:
    """A write to a file of the cache fails if the files of the cache would exceed `limit` bytes."""
    import builtins
    import errno
    import io

    builtin_open = builtins.open

    def limited_open(file, mode="r", *arguments, **options):  # type: ignore[no-untyped-def]
        stream = builtin_open(file, mode, *arguments, **options)
        if (".safetensors" not in str(file) and ".partial" not in str(file)) or not set(mode) & set(
            "wax"
        ):
            return stream
        root = os.path.dirname(os.path.dirname(os.path.abspath(file)))

        class Full(io.BufferedWriter):
            def write(self, data):  # type: ignore[no-untyped-def, override]
                used = sum(
                    os.path.getsize(os.path.join(at, name))
                    for at, _, names in os.walk(root)
                    for name in names
                )
                if used + len(data) > limit:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))
                return super().write(data)

        return Full(stream.detach())

    builtins.open = limited_open


def _clock_behind(seconds: float) -> None:
    now = time.time
    now_ns = time.time_ns
    time.time = lambda: now() - seconds
    time.time_ns = lambda: now_ns() - int(seconds * 1e9)


if _NAME == "rename":
    _no_rename()
elif _NAME == "full":
    _no_space(int(_VALUE))
elif _NAME == "clock":
    _clock_behind(float(_VALUE))
