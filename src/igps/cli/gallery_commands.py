"""The commands of `igps gallery`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps._text import counted
from igps.cli.shared_options import Mirror, Size
from igps.mesh.options import LoadOptions
from igps.signature.config import SignatureConfig

if TYPE_CHECKING:
    from igps.data.dataset import Failure
    from igps.gallery.gallery import Gallery


def build(
    root: Path,
    out: Path,
    descriptor: str = "pretrained",
    size: Size = "auto",
    mirror: Mirror = "auto",
    n_workers: int | None = None,
    strict: bool = False,
    **reading: Any,
) -> None:
    """Describe the bodies of a folder and store them in a gallery, which igps query searches without their files.

    An existing gallery is replaced only when the new one is complete; its previous state remains as a version.

    Args:
        out: folder of the gallery, such as gallery.igps; created if missing.
    """
    from igps._progress import number_bars
    from igps.cli.reading import Folder, signatures, with_side, with_size
    from igps.descriptors import descriptor as descriptor_of
    from igps.gallery.gallery import Gallery
    from igps.gallery.opening import tables
    from igps.nn.description import check_centres

    if reading.get("complete"):
        raise ValueError(
            "complete: a gallery has all bodies of its folder, as igps gallery sync brings it up to date. "
            "Leave it out, or build from a folder without the cut bodies."
        )
    descriptor = with_side(descriptor, mirror, size)
    module = descriptor_of(descriptor)
    check_centres(module)
    tables().check_place(out)
    number_bars(2)
    dataset, unread = signatures(
        Folder(root), [module], n_workers=n_workers, strict=strict, **reading
    )
    descriptor = with_size(descriptor, size, dataset)
    gallery, undescribed = Gallery.build(
        out, dataset, descriptor, n_workers=n_workers, strict=strict, progress=True
    )
    _print_state(gallery, [*unread, *undescribed])


def sync(
    root: Path, gallery: Path, n_workers: int | None = None, strict: bool = False, **collection: Any
) -> None:
    """Update a gallery from a folder: describe new and changed files, update labels, remove bodies of deleted files.

    Args:
        root: folder of meshes, with or without classes; the gallery keeps bodies that come from other folders.
    """
    from igps.cli.reading import Folder, dataset_from_options
    from igps.gallery.gallery import Gallery
    from igps.gallery.sync import sync as sync_folder

    opened = Gallery(gallery)
    collection = gallery_options(opened, collection)
    dataset = dataset_from_options(Folder(root), opened.descriptor.requirements, **collection)
    n_new, n_gone, failures = sync_folder(
        opened, dataset, root, n_workers=n_workers, strict=strict, progress=True
    )
    print(f"{counted(n_new, 'body')} described, {n_gone} removed")
    _print_state(opened, failures)


def remove(gallery: Path, where: str) -> None:
    """Remove bodies from a gallery; their files stay.

    Args:
        where: condition on columns of the gallery, such as "class = 'femur' AND volume > 2e5".
    """
    from igps.gallery.gallery import Gallery

    opened = Gallery(gallery)
    print(f"{opened.remove(where)} bodies removed")
    _print_state(opened, [])


def info(gallery: Path) -> dict[str, Any]:
    """Show the number of bodies of a gallery, its columns, and its descriptor."""
    from igps.gallery.gallery import Gallery

    opened = Gallery(gallery)
    contents = {
        "bodies": len(opened),
        "columns": {name: kind.__name__ for name, kind in opened.columns.items()},
    }
    print(f"{_in_words(opened)}; columns: {', '.join(opened.columns)}")
    return {**contents, **opened.about}


def gallery_options(gallery: Gallery, reading: Mapping[str, Any]) -> dict[str, Any]:
    """Return reading options with those of the gallery filled in; raise a ValueError if an option contradicts them."""
    from igps.cli.reading import with_side
    from igps.descriptors.size_and_side import SIDE, SIZE
    from igps.gallery.about import about_of, check_alike

    options = dict(reading)
    check = partial(check_alike, gallery.path, gallery.about)
    size = options.pop("size", "auto")
    mirror = options.pop("mirror", "auto")
    name = gallery.about["descriptor"]
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
    skipped = f"; {counted(len(failures), 'body')} skipped" if failures else ""
    print(f"{_in_words(gallery)}{skipped}")


def _in_words(gallery: Gallery) -> str:
    return f"{gallery.path}: {counted(len(gallery), 'body')} by {gallery.about['descriptor']}"
