"""The command `igps duplicates`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps._text import counted
from igps.cli.options import Size

if TYPE_CHECKING:
    from igps.data.dataset import Failure
    from igps.duplicates.duplicates import Duplicates


DESCRIPTOR = "pretrained"
"""The only descriptor whose distances are calibrated."""


def duplicates(
    root: Path,
    poses: bool = False,
    size: Size = "auto",
    tolerance: float = 0.0,
    out: Path | None = None,
    **reading: Any,
) -> dict[str, Any]:
    """List files that show the same body, also as a mirror image, at another scale, or with other triangles or detail.

    Args:
        root: folder of meshes, or a gallery, see igps gallery.
        poses: also count other poses of a body as duplicates; more bodies that are only similar are then listed too
        size: keep treats bodies of different size as different, ignore does not; auto is keep where all files have a
            unit.
        tolerance: also list pairs that are not duplicates but no farther apart than this fraction of the square root of
            the area, at most 0.02.
        out: CSV file for the groups.
    """
    from igps.cli.gallery import gallery_options
    from igps.cli.reading import Folder, signatures
    from igps.descriptors import descriptor as descriptor_of
    from igps.descriptors.size_and_side import keeps_size
    from igps.duplicates.duplicates import duplicates as find_duplicates
    from igps.duplicates.duplicates import pose_duplicates
    from igps.duplicates.surfaces import MAX_TOLERANCE
    from igps.gallery.gallery import Gallery
    from igps.gallery.opening import is_gallery
    from igps.report.tables import write_rows

    if not 0 <= tolerance <= (0 if poses else MAX_TOLERANCE):
        expected = "0 with poses" if poses else f"0 to {MAX_TOLERANCE}"
        raise ValueError(f"tolerance: expected {expected}, got {tolerance}.")
    source: Any
    unread: list[Failure] = []
    if is_gallery(root):
        source = Gallery(root)
        gallery_options(source, reading)
    else:
        source, unread = signatures(
            Folder(root, needs_meshes=True), [descriptor_of(DESCRIPTOR)], **reading
        )
    units = (
        [row["unit"] for row in source.rows("unit")]
        if isinstance(source, Gallery)
        else source.units()
    )
    if warning := keeps_size(size, units)[1]:
        print(warning)
    shared = {name: reading.get(name) for name in ("cache_dir", "n_workers")}
    if poses:
        result = pose_duplicates(source, DESCRIPTOR, size=size, progress=True, **shared)
    else:
        result = find_duplicates(source, size=size, tolerance=tolerance, progress=True, **shared)
    _print_groups(result, poses)
    if failures := [*result.failures, *unread]:
        print(
            f"{counted(len(failures), 'file')} could not be compared. The first: {failures[0].error}"
        )
    if out is not None:
        rows = [
            (n, name, result.paths[name])
            for n, group in enumerate(result.groups, 1)
            for name in group
        ]
        write_rows(out, ("group", "name", "path"), rows)
    pairs: list[dict[str, Any]] = []
    for pair, apart in result.pairs.items():
        largest = dict(
            zip(("largest", "largest_length", "unit"), result.largest.get(pair, ()), strict=False)
        )
        pairs.append(
            {
                "files": list(pair),
                "distance": apart,
                "grade": result.grades.get(pair),
                "mirrored": pair in result.mirrored,
                **largest,
            }
        )
    return {
        "groups": [list(group) for group in result.groups],
        "pairs": pairs,
        "nearly": [
            {"files": list(pair), "distance": apart} for pair, apart in result.nearly.items()
        ],
        "n_files": result.n_files,
        "n_skipped": len(failures),
    }


def _print_groups(result: Duplicates, poses: bool) -> None:
    from igps.duplicates.calibration import Calibration

    for number, group in enumerate(result.groups, 1):
        print(f"group {number}: " + "  ".join(group))
    for pair in sorted(result.mirrored):
        print(f"mirror image: {'  '.join(pair)}")
    for pair, distance in result.nearly.items():
        print(f"nearly: {'  '.join(pair)}  {distance:.3%} of the square root of the area apart")
    calibration = Calibration.load()
    n_grouped = sum(map(len, result.groups))
    threshold, kind = (calibration.pose, "poses") if poses else (calibration.detail, "copies")
    grades = "".join(
        f"; {counted(n, 'pair')} {grade}"
        for grade, n in Counter(result.grades.values()).most_common()
    )
    print(
        f"{n_grouped} of {result.n_files} files in {len(result.groups)} groups; on generated bodies, this finds "
        f"{threshold.n_found} of {threshold.n_same} pairs of {kind} and mistakes {threshold.n_false} of "
        f"{threshold.n_other} other pairs for {kind}{grades}"
    )
