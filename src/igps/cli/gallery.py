"""`igps gallery`."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from igps.cli.reading import Folder, MirrorOption, chosen_dataset, signatures, sized, tell_units, with_side
from igps.data.dataset import Failure
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.individual import SIDE, SIZE, Size
from igps.gallery.about import about_of, check_alike, tables
from igps.gallery.gallery import Gallery
from igps.gallery.sync import sync as sync_folder
from igps.mesh.options import LoadOptions
from igps.nn.description import check_centres
from igps.signature.signature import SignatureConfig


def build(
    root: Path, out: Path, descriptor: str = "pretrained", size: Size = "auto", mirror: MirrorOption = "auto",
    n_workers: int | None = None, strict: bool = False, **reading: Any,
) -> None:  # fmt: skip
    """Describe the bodies of a folder into a gallery, to be asked by igps query without their files.

    A gallery that is there keeps its state until the new one is complete, which then is a version of it.

    Args:
        out: the gallery, a folder that will be made, such as gallery.igps.
    """
    descriptor = with_side(descriptor, mirror, size)
    chosen = descriptor_of(descriptor)
    check_centres(chosen)
    tables().check_place(out)
    dataset, unread = signatures(Folder(root), [chosen], n_workers=n_workers, strict=strict, **reading)
    descriptor = sized(descriptor, size, dataset)
    gallery, undescribed = Gallery.build(out, dataset, descriptor, n_workers=n_workers, strict=strict, progress=True)
    _print_state(gallery, [*unread, *undescribed])


def add(root: Path, gallery: Path, n_workers: int | None = None, strict: bool = False, **reading: Any) -> None:
    """Add the bodies of a folder to a gallery, by its own descriptor; those that it has already are passed over."""
    opened = Gallery(gallery)
    reading = as_described(opened, reading)
    dataset, unread = signatures(Folder(root), [opened.descriptor], n_workers=n_workers, strict=strict, **reading)
    tell_units(opened.descriptor, dataset)
    undescribed = opened.add(dataset, n_workers=n_workers, strict=strict, progress=True)
    _print_state(opened, [*unread, *undescribed])


def sync(root: Path, gallery: Path, n_workers: int | None = None, strict: bool = False, **reading: Any) -> None:
    """Bring a gallery up to a folder: describe new and changed files, take labels over, remove deleted files.

    Args:
        root: folder of meshes, with or without classes; bodies of other folders stay.
    """
    opened = Gallery(gallery)
    reading = as_described(opened, reading)
    dataset = chosen_dataset(Folder(root), opened.descriptor.requirements, **reading)
    n_new, n_gone, failures = sync_folder(opened, dataset, root, n_workers=n_workers, strict=strict, progress=True)
    print(f"{n_new} bodies described, {n_gone} removed")
    _print_state(opened, failures)


def merge(others: list[Path], out: Path) -> None:
    """Make one gallery of several, which stay as they are.

    Args:
        others: the galleries, all of one descriptor.
        out: the gallery of all; where there is one already, they are added to it.
    """
    _print_state(Gallery.merge(out, others, progress=True), [])


def remove(gallery: Path, where: str) -> None:
    """Remove bodies from a gallery; their files stay.

    Args:
        where: a condition on its columns, such as "class = 'femur' AND volume > 2e5".
    """
    opened = Gallery(gallery)
    print(f"{opened.remove(where)} bodies removed")
    _print_state(opened, [])


def update(gallery: Path, where: str, to: list[str]) -> None:
    """Set columns of bodies in a gallery.

    Args:
        where: a condition on its columns, such as "name LIKE 'left/%'".
        to: values by column, such as class=femur age=41; nothing after the sign empties it.
    """
    if wrong := [one for one in to if "=" not in one]:
        raise ValueError(f"to: expected COLUMN=VALUE, got {wrong[0]!r}.")
    values = {name: value or None for name, _, value in (one.partition("=") for one in to)}
    print(f"{Gallery(gallery).update(where, values)} bodies updated")


def info(gallery: Path, version: int | None = None) -> dict[str, Any]:
    """Tell what a gallery holds, and how it was described.

    Args:
        version: an earlier one of its versions.
    """
    opened = Gallery(gallery, version=version)
    told = {"bodies": len(opened), "columns": {name: kind.__name__ for name, kind in opened.columns.items()}}
    print(f"{opened.path}: {len(opened)} bodies by {opened.about['descriptor']}; columns: {', '.join(opened.columns)}")
    return {**told, **opened.about}


def versions(gallery: Path) -> list[dict[str, Any]]:
    """List the versions of a gallery: each change makes one."""
    versions = Gallery(gallery).versions()
    for one in versions:
        print(f"{one['version']:>6}  {one['time']}  {one['bodies']} bodies")
    return versions


def restore(gallery: Path, version: int) -> None:
    """Return to an earlier version of a gallery; those between stay.

    Args:
        version: its number, see igps gallery versions.
    """
    opened = Gallery(gallery)
    opened.restore(version)
    _print_state(opened, [])


def as_described(gallery: Gallery, reading: Mapping[str, Any]) -> dict[str, Any]:
    """How meshes are read, as it was when the gallery was built; a ValueError where something else is asked for."""
    given, check = dict(reading), partial(check_alike, gallery.path, gallery.about)
    size, mirror, name = given.pop("size", "auto"), given.pop("mirror", "auto"), gallery.about["descriptor"]
    if size != "auto":
        check({"descriptor": name.replace(SIZE, "") + SIZE * (size == "keep")})
    if mirror == "distinct":
        check({"descriptor": with_side(name, mirror, "auto")})
    elif mirror == "same":
        check({"descriptor": name.replace(SIDE, "")})
    config = given.pop("signature", SignatureConfig())
    if given.pop("paper", False):
        config = SignatureConfig.paper()
    asked = LoadOptions(**{one.name: given.pop(one.name, one.default) for one in fields(LoadOptions)})
    if config != SignatureConfig():
        wanted = gallery.descriptor.requirements.apply_to(config).resolved()
        check({"signature": about_of(wanted, asked, gallery.descriptor)["signature"]})
    if asked.as_dict() != LoadOptions().as_dict():
        check({"reading": asked.as_dict()})
    read = replace(gallery.reading, names=asked.names or gallery.reading.names, max_unpacked=asked.max_unpacked)
    return {**given, "signature": gallery.config, **asdict(read)}


def _print_state(gallery: Gallery, failures: Sequence[Failure]) -> None:
    skipped = f"; {len(failures)} bodies skipped" if failures else ""
    print(f"{gallery.path}: {len(gallery)} bodies by {gallery.about['descriptor']}{skipped}")
