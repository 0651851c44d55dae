"""`igps duplicates` and `igps distance`."""

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from igps.cli.gallery import as_described
from igps.cli.reading import Folder, check_files, signatures
from igps.data.dataset import Failure
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.individual import Size, keeps_size
from igps.gallery.about import is_gallery
from igps.gallery.calibration import Calibration
from igps.gallery.duplicates import Duplicates, body_distance
from igps.gallery.duplicates import duplicates as find_duplicates
from igps.gallery.gallery import Gallery
from igps.gallery.surfaces import MOST_TOLERATED
from igps.mesh.mesh import millimetres
from igps.report.tables import write_rows

DESCRIPTOR = "pretrained"
"""The one whose distances are calibrated."""


def duplicates(
    root: Path,
    poses: bool = False,
    size: Size = "auto",
    tolerance: float = 0.0,
    out: Path | None = None,
    **reading: Any,
) -> dict[str, Any]:
    """List the files that show the same body, whatever its mirror image, triangles, detail, format, and unitless scale.

    Args:
        root: folder of meshes, or a gallery of them, see igps gallery.
        poses: take other poses of a body for the same, which mistakes more siblings for it
        size: keep takes files that differ in size for different, ignore does not; auto does where all have a unit.
        tolerance: tell pairs, too, that are not the same and no farther apart, in parts of the root of the area; 0.02
            at most.
        out: a table of the groups, a file ending in .csv.
    """
    if not 0 <= tolerance <= (0 if poses else MOST_TOLERATED):
        told = "0 beside poses" if poses else f"0 to {MOST_TOLERATED}"
        raise ValueError(f"tolerance: expected {told}, got {tolerance}.")
    source: Any
    unread: list[Failure] = []
    if is_gallery(root):
        source = Gallery(root)
        as_described(source, reading)
    else:
        source, unread = signatures(Folder(root, needs_meshes=True), [descriptor_of(DESCRIPTOR)], **reading)
    units = [one["unit"] for one in source.rows("unit")] if isinstance(source, Gallery) else source.units()
    if told := keeps_size(size, units)[1]:
        print(told)
    kept = {name: reading.get(name) for name in ("cache_dir", "n_workers")}
    found = find_duplicates(source, DESCRIPTOR, poses=poses, size=size, tolerance=tolerance, progress=True, **kept)
    _print_groups(found, poses)
    if failures := [*found.failures, *unread]:
        print(f"{len(failures)} files could not be compared; {failures[0].error}")
    if out is not None:
        rows = [(n, name, found.paths[name]) for n, group in enumerate(found.groups, 1) for name in group]
        write_rows(out, ("group", "name", "path"), rows)
    pairs: list[dict[str, Any]] = []
    for pair, apart in found.pairs.items():
        largest = dict(zip(("largest", "largest_length", "unit"), found.largest.get(pair, ()), strict=False))
        pairs.append({"files": list(pair), "distance": apart, "grade": found.grades.get(pair), **largest})
    return {
        "groups": [list(group) for group in found.groups],
        "pairs": pairs,
        "nearly": [{"files": list(pair), "distance": apart} for pair, apart in found.nearly.items()],
        "n_files": found.n_files,
        "n_skipped": len(failures),
    }


def distance(meshes: list[Path], **reading: Any) -> dict[str, Any]:
    """Tell how far two bodies are from each other by pretrained, and what that means.

    Args:
        meshes: two files.
    """
    if len(meshes) != 2:
        raise ValueError(f"meshes: expected two files, got {len(meshes)}.")
    check_files(meshes)
    reading["strict"] = True  # within `**reading`, where the parser finds the options
    dataset, _ = signatures(meshes, [descriptor_of(DESCRIPTOR)], **reading)
    found = body_distance(dataset, DESCRIPTOR, progress=True)
    print(f"{found.distance:.4g} by {DESCRIPTOR}: {found.meaning}")
    told = "the same shape" if found.same else "not the same shape"
    why = f"at their level of detail, the same up to {found.limit:.3%}" if found.limit else "other handles or vertices"
    print(f"surfaces laid onto each other: {found.surfaces:.3%} of the root of the area apart, {told} ({why})")
    first, second = (one.area**0.5 * millimetres(one.unit) for one in dataset.signatures())
    print(f"lengths of the second are {second / first:.4g} times those of the first")
    return {"descriptor": DESCRIPTOR, **asdict(found), "lengths": second / first}


def _print_groups(found: Duplicates, poses: bool) -> None:
    for number, group in enumerate(found.groups, 1):
        print(f"group {number}: " + "  ".join(group))
    for pair, distance in found.nearly.items():
        print(f"nearly: {'  '.join(pair)}  {distance:.3%} of the root of the area apart")
    calibration, n_alike = Calibration.load(), sum(map(len, found.groups))
    threshold, what = (calibration.pose, "poses") if poses else (calibration.detail, "copies")
    print(
        f"{n_alike} of {found.n_files} files in {len(found.groups)} groups; of generated bodies, {threshold.n_found} "
        f"of {threshold.n_same} pairs of {what} are found, and {threshold.n_false} of {threshold.n_other} others taken "
        "for such" + "".join(f"; {n} pairs {grade}" for grade, n in Counter(found.grades.values()).most_common())
    )
