"""The commands of `igps gallery`."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from igps.cli.reading import (
    Folder,
    MirrorOption,
    dataset_from_options,
    print_unit_warning,
    signatures,
    with_side,
    with_size,
)
from igps.data.dataset import Failure
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.size_and_side import SIDE, SIZE, Size
from igps.gallery.about import about_of, check_alike
from igps.gallery.gallery import Gallery
from igps.gallery.opening import tables
from igps.gallery.sync import sync as sync_folder
from igps.mesh.options import LoadOptions
from igps.nn.description import check_centres
from igps.signature.signature import SignatureConfig


def build(
    root: Path,
    out: Path,
    descriptor: str = "pretrained",
    size: Size = "auto",
    mirror: MirrorOption = "auto",
    n_workers: int | None = None,
    strict: bool = False,
    **reading: Any,
) -> None:
    """Describe the bodies of a folder and store them in a gallery, which igps query searches without their files.

    An existing gallery is replaced only when the new one is complete; its previous state remains as a version.

    Args:
        out: folder of the gallery, such as gallery.igps; created if missing.
    """
    descriptor = with_side(descriptor, mirror, size)
    module = descriptor_of(descriptor)
    check_centres(module)
    tables().check_place(out)
    dataset, unread = signatures(
        Folder(root), [module], n_workers=n_workers, strict=strict, **reading
    )
    descriptor = with_size(descriptor, size, dataset)
    gallery, undescribed = Gallery.build(
        out, dataset, descriptor, n_workers=n_workers, strict=strict, progress=True
    )
    _print_state(gallery, [*unread, *undescribed])


def add(
    root: Path, gallery: Path, n_workers: int | None = None, strict: bool = False, **reading: Any
) -> None:
    """Add the bodies of a folder to a gallery, with the gallery's descriptor; bodies already in it are skipped."""
    opened = Gallery(gallery)
    reading = gallery_options(opened, reading)
    dataset, unread = signatures(
        Folder(root), [opened.descriptor], n_workers=n_workers, strict=strict, **reading
    )
    print_unit_warning(opened.descriptor, dataset)
    undescribed = opened.add(dataset, n_workers=n_workers, strict=strict, progress=True)
    _print_state(opened, [*unread, *undescribed])


def sync(
    root: Path, gallery: Path, n_workers: int | None = None, strict: bool = False, **reading: Any
) -> None:
    """Update a gallery from a folder: describe new and changed files, update labels, remove bodies of deleted files.

    Args:
        root: folder of meshes, with or without classes; the gallery keeps bodies that come from other folders.
    """
    opened = Gallery(gallery)
    reading = gallery_options(opened, reading)
    dataset = dataset_from_options(Folder(root), opened.descriptor.requirements, **reading)
    n_new, n_gone, failures = sync_folder(
        opened, dataset, root, n_workers=n_workers, strict=strict, progress=True
    )
    print(f"{n_new} bodies described, {n_gone} removed")
    _print_state(opened, failures)


def merge(others: list[Path], out: Path) -> None:
    """Merge several galleries into one; the originals stay unchanged.

    Args:
        others: the galleries to merge, all of the same descriptor.
        out: the merged gallery; if it exists, the others are added to it.
    """
    _print_state(Gallery.merge(out, others, progress=True), [])


def remove(gallery: Path, where: str) -> None:
    """Remove bodies from a gallery; their files stay.

    Args:
        where: condition on columns of the gallery, such as "class = 'femur' AND volume > 2e5".
    """
    opened = Gallery(gallery)
    print(f"{opened.remove(where)} bodies removed")
    _print_state(opened, [])


def update(gallery: Path, where: str, to: list[str]) -> None:
    """Set columns of bodies in a gallery.

    Args:
        where: condition on columns of the gallery, such as "name LIKE 'left/%'".
        to: values by column, such as class=femur age=41; COLUMN= clears the value.
    """
    if wrong := [assignment for assignment in to if "=" not in assignment]:
        raise ValueError(f"to: expected COLUMN=VALUE, got {wrong[0]!r}.")
    values = {
        name: value or None for name, _, value in (assignment.partition("=") for assignment in to)
    }
    print(f"{Gallery(gallery).update(where, values)} bodies updated")


def info(gallery: Path, version: int | None = None) -> dict[str, Any]:
    """Show the number of bodies of a gallery, its columns, and its descriptor.

    Args:
        version: number of an earlier version, see igps gallery versions.
    """
    opened = Gallery(gallery, version=version)
    contents = {
        "bodies": len(opened),
        "columns": {name: kind.__name__ for name, kind in opened.columns.items()},
    }
    print(
        f"{opened.path}: {len(opened)} bodies by {opened.about['descriptor']}; columns: {', '.join(opened.columns)}"
    )
    return {**contents, **opened.about}


def versions(gallery: Path) -> list[dict[str, Any]]:
    """List the versions of a gallery; every change of a gallery creates a version."""
    versions = Gallery(gallery).versions()
    for row in versions:
        print(f"{row['version']:>6}  {row['time']}  {row['bodies']} bodies")
    return versions


def restore(gallery: Path, version: int) -> None:
    """Return a gallery to an earlier version; later versions remain available.

    Args:
        version: number of the version, see igps gallery versions.
    """
    opened = Gallery(gallery)
    opened.restore(version)
    _print_state(opened, [])


def gallery_options(gallery: Gallery, reading: Mapping[str, Any]) -> dict[str, Any]:
    """Return reading options with those of the gallery filled in; raise a ValueError if an option contradicts them."""
    options, check = dict(reading), partial(check_alike, gallery.path, gallery.about)
    size, mirror, name = (
        options.pop("size", "auto"),
        options.pop("mirror", "auto"),
        gallery.about["descriptor"],
    )
    if size != "auto":
        check({"descriptor": name.replace(SIZE, "") + SIZE * (size == "keep")})
    if mirror == "distinct":
        check({"descriptor": with_side(name, mirror, "auto")})
    elif mirror == "same":
        check({"descriptor": name.replace(SIDE, "")})
    config = options.pop("signature", SignatureConfig())
    if options.pop("paper", False):
        config = SignatureConfig.paper()
    load = LoadOptions(
        **{field.name: options.pop(field.name, field.default) for field in fields(LoadOptions)}
    )
    if config != SignatureConfig():
        resolved = gallery.descriptor.requirements.apply_to(config).resolved()
        check({"signature": about_of(resolved, load, gallery.descriptor)["signature"]})
    if load.as_dict() != LoadOptions().as_dict():
        check({"reading": load.as_dict()})
    # Names of labels and the size limit do not change a description
    load = replace(
        gallery.reading, names=load.names or gallery.reading.names, max_unpacked=load.max_unpacked
    )
    return {**options, "signature": gallery.config, **asdict(load)}


def _print_state(gallery: Gallery, failures: Sequence[Failure]) -> None:
    skipped = f"; {len(failures)} bodies skipped" if failures else ""
    print(f"{gallery.path}: {len(gallery)} bodies by {gallery.about['descriptor']}{skipped}")
