"""Jobs for other processes: functions that a worker can import."""

import errno
import importlib
import os
import signal
import time
from pathlib import Path


def square(x):
    if x < 0:
        raise ValueError(f"x: expected a natural number, got {x}.")
    if x == 13:
        raise KeyError("thirteen")
    return x * x


def die_at_zero(x):
    if x == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return x


def interrupt(x):
    """Ctrl-C, as a worker gets it."""
    os.kill(os.getpid(), signal.SIGINT)
    return x


def die_once(marker):
    """Die if the file is missing, and leave it."""
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return marker.name


def sleep(seconds):
    time.sleep(seconds)
    return seconds


def allocate(n_bytes):
    return len(bytearray(n_bytes))


def pages_cleared(n_bytes):
    """How many pages the system hands out for so many bytes."""
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    bytearray(b"x") * n_bytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def huge_pages():
    """When the system hands out huge pages, as Linux says it."""
    setting = Path("/sys/kernel/mm/transparent_hugepage/enabled")
    return setting.read_text() if setting.exists() else ""


def fail_with(number):
    """Raise the system's error of a number; a MemoryError for 0."""
    if number == 0:
        raise MemoryError
    raise OSError(number, errno.errorcode[number])


def call(job):
    return job()


def need_library(name):
    """Import what is not installed."""
    importlib.import_module(name)


def process(_):
    """Which process this is, and how many threads it was told to take."""
    return os.getpid(), os.environ.get("OMP_NUM_THREADS")
