"""The command `igps precompute`."""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import Iterator
from concurrent.futures import Executor
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any

_SCHEDULER_TIMEOUT = 15  # seconds


def precompute(
    root: Path,
    descriptors: list[str] = ["pretrained"],  # noqa: B006 (only read)
    cluster: str | None = None,
    shard: str | None = None,
    failures: Path | None = None,
    strict: bool = False,
    n_workers: int | None = None,
    time_limit: float | None = None,
    memory_limit: float | None = None,
    **collection: Any,
) -> None:
    """Compute the signatures of a folder of meshes and store them in the cache, on this machine or on a cluster.

    Signatures in the cache are not computed again, so a second run completes one that was interrupted.

    Args:
        descriptors: descriptors whose requirements the signatures must meet.
        cluster: address of a Dask scheduler, such as tcp://scheduler:8786; its workers must see the folder and the
            cache under the same paths as this machine.
        shard: part of the meshes for one job of a batch system, such as 3/64, the third of 64 parts.
        failures: CSV file for the meshes that cannot be used.
    """
    from igps.cli.reading import Folder, dataset_from_options
    from igps.cli.shared_options import limits_of
    from igps.descriptors import descriptor as descriptor_of
    from igps.report.tables import write_rows

    requirements = reduce(or_, (descriptor_of(name).requirements for name in descriptors))
    dataset = dataset_from_options(Folder(root), requirements, **collection)
    dataset = dataset.subset(of_shard(len(dataset), shard))
    if not len(dataset):
        print(f"{root}: no body in shard {shard}")
        return
    limits = limits_of(time_limit, memory_limit)
    if cluster is None:
        failed = dataset.precompute(n_workers=n_workers, strict=strict, limits=limits)
    else:
        with dask_executor(cluster) as executor:
            failed = dataset.precompute(executor, strict=strict, limits=limits)
    if failures is not None:
        write_rows(failures, ("name", "error"), [(failure.id, failure.error) for failure in failed])
    part = "" if shard is None else f" in shard {shard}"
    print(
        f"{len(dataset) - len(failed)} of {len(dataset)} signatures{part} are in the cache; {len(failed)} failed"
    )


def of_shard(n_bodies: int, shard: str | None) -> range:
    """Return the indices of the bodies of a shard k/n: every n-th body, from the k-th on; all bodies if None."""
    if shard is None:
        return range(n_bodies)
    match = re.fullmatch(r"([1-9]\d*)/([1-9]\d*)", shard)
    if match is None or int(match[1]) > int(match[2]):
        raise ValueError(f"shard: expected a part such as 3/64, from 1/64 to 64/64, got {shard!r}.")
    return range(int(match[1]) - 1, n_bodies, int(match[2]))


@contextlib.contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """Yield an executor on the workers of a Dask scheduler.

    Raises:
        MachineError: no scheduler answers, or a worker has another version of the library.
    """
    from igps.data.pipeline import version
    from igps.failures import MachineError

    try:
        from distributed import Client
    except ImportError as error:
        raise ImportError('cluster: needs Dask: pip install "interior-gps[cluster]".') from error
    # A lost scheduler is reported in one sentence; Dask would log tracebacks of its attempts to reconnect
    for name in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_SCHEDULER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:  # a TimeoutError is an OSError
        raise MachineError(
            f"cluster: no Dask scheduler answers at {address}. Start one with `dask scheduler`, and workers with `dask "
            "worker` and its address."
        ) from error
    with client:
        for worker, answer in client.run(version, on_error="return").items():
            if answer != version():
                shown = (
                    answer
                    if isinstance(answer, str)
                    else f"of another version ({type(answer).__name__})"
                )
                raise MachineError(
                    f"cluster: expected igps {version()} on every worker, the one at {worker} has igps {shown}. "
                    "Install one version everywhere and run again."
                )
        yield client.get_executor()
