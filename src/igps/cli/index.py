"""`igps index`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from igps.cli.reading import Folder, signatures, sized, with_side
from igps.data.dataset import Failure
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.individual import SIZE, Mirror, Size
from igps.gallery.gallery import Gallery, about_of
from igps.mesh.options import LoadOptions
from igps.retrieval.index import check_alike
from igps.signature.signature import SignatureConfig


def index_build(
    root: Path,
    out: Path,
    descriptor: str = "pretrained",
    size: Size = "auto",
    mirror: Mirror = "same",
    n_workers: int | None = None,
    strict: bool = False,
    **reading: Any,
) -> None:
    """Index the meshes of a folder, to be asked by igps query without their files.

    An index that is there keeps its state until the new one is complete, and is replaced by it then.

    Args:
        root: folder of meshes, with or without classes.
        out: the index, a folder that will be made, such as gallery.igps.
        descriptor: a name (a wrong one lists all), or package.module:NAME of one of your own.
        size: keep lets differences in size count, ignore does not; auto keeps it where all files have a unit of length.
        mirror: distinct tells a body from its mirror image.
        n_workers: processes that compute; all cores if not given.
        strict: stop at the first mesh that cannot be used instead of skipping it
    """
    descriptor = with_side(descriptor, mirror)
    chosen = descriptor_of(descriptor)
    dataset, unread = signatures(Folder(root), [chosen], n_workers=n_workers, strict=strict, **reading)
    descriptor = sized(descriptor, size, dataset)
    gallery, undescribed = Gallery.build(out, dataset, descriptor, n_workers=n_workers, strict=strict, progress=True)
    _print_state(gallery, [*unread, *undescribed])


def index_add(
    root: Path,
    index: Path,
    n_workers: int | None = None,
    strict: bool = False,
    **reading: Any,
) -> None:
    """Add the meshes of a folder to an index, by its own descriptor; those that it has already are passed over.

    Args:
        root: folder of meshes, with or without classes.
        index: the index.
        n_workers: processes that compute; all cores if not given.
        strict: stop at the first mesh that cannot be used instead of skipping it
    """
    gallery = Gallery(index)
    reading = as_indexed(gallery, reading)
    dataset, unread = signatures(Folder(root), [gallery.descriptor], n_workers=n_workers, strict=strict, **reading)
    name = gallery.index.about["descriptor"]
    gallery, undescribed = Gallery.add(index, dataset, name, n_workers=n_workers, strict=strict, progress=True)
    _print_state(gallery, [*unread, *undescribed])


def index_merge(others: list[Path], out: Path) -> None:
    """Make one index of several, which stay as they are.

    Args:
        others: the indices, all of one descriptor.
        out: the index of all; where there is one already, they are added to it.
    """
    _print_state(Gallery.merge(out, others, progress=True), [])


def as_indexed(gallery: Gallery, reading: Mapping[str, Any]) -> dict[str, Any]:
    """The options of how meshes are read, as they were when the index was built.

    Raises:
        ValueError: others are asked for.
    """
    given = dict(reading)
    size, mirror, name = given.pop("size", "auto"), given.pop("mirror", "same"), gallery.index.about["descriptor"]
    if size != "auto":
        check_alike(gallery.index, {"descriptor": name.replace(SIZE, "") + SIZE * (size == "keep")})
    check_alike(gallery.index, {"descriptor": with_side(name, mirror)})
    config = given.pop("signature", SignatureConfig())
    if given.pop("paper", False):
        config = SignatureConfig.paper()
    asked = LoadOptions(**{one.name: given.pop(one.name, one.default) for one in fields(LoadOptions)})
    if config != SignatureConfig():
        wanted = gallery.descriptor.requirements.apply_to(config).resolved()
        check_alike(gallery.index, {"signature": about_of(wanted, asked, gallery.descriptor)["signature"]})
    if asked != LoadOptions():
        check_alike(gallery.index, {"reading": about_of(gallery.config, asked, gallery.descriptor)["reading"]})
    return {**given, "signature": gallery.config, **asdict(gallery.reading)}


def _print_state(gallery: Gallery, failures: Sequence[Failure]) -> None:
    skipped = f"; {len(failures)} meshes skipped" if failures else ""
    print(f"{gallery.path}: {len(gallery)} meshes by {gallery.index.about['descriptor']}{skipped}")
