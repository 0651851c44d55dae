"""The command `igps duplicates`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps._text import counted
from igps.cli.shared_options import Size

if TYPE_CHECKING:
    from igps.duplicates.duplicates import Duplicates


DESCRIPTOR = "pretrained"
"""The only descriptor whose distances are calibrated."""


def duplicates(
    root: Path,
    size: Size = "auto",
    out: Path | None = None,
    **reading: Any,
) -> dict[str, Any]:
    """List files that show the same body, also as a mirror image, at another scale, or with other triangles or detail.

    Args:
        root: folder of meshes.
        size: keep treats bodies of different size as different, ignore does not; auto is keep where all files have a
            unit.
        out: CSV file for the groups.
    """
    from igps.cli.reading import Folder, signatures
    from igps.descriptors import descriptor as descriptor_of
    from igps.descriptors.size_and_side import keeps_size
    from igps.duplicates.duplicates import duplicates as find_duplicates
    from igps.report.tables import write_rows

    dataset, unread = signatures(Folder(root), [descriptor_of(DESCRIPTOR)], **reading)
    if warning := keeps_size(size, dataset.units())[1]:
        print(warning)
    n_workers = reading.get("n_workers")
    result = find_duplicates(dataset, size=size, n_workers=n_workers, progress=True)
    _print_groups(result)
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
    pairs = [
        {
            "files": list(copy.names),
            "distance": copy.distance,
            "grade": copy.grade,
            "mirrored": copy.is_mirrored,
            "largest": copy.deviation,
            "largest_length": copy.largest_length,
            "unit": copy.unit,
        }
        for copy in result.copies
    ]
    return {
        "groups": [list(group) for group in result.groups],
        "pairs": pairs,
        "n_files": result.n_files,
        "n_skipped": len(failures),
    }


def _print_groups(result: Duplicates) -> None:
    from igps.duplicates.calibration import Calibration

    for number, group in enumerate(result.groups, 1):
        print(f"group {number}: " + "  ".join(group))
    for names in sorted(copy.names for copy in result.copies if copy.is_mirrored):
        print(f"mirror image: {'  '.join(names)}")
    threshold = Calibration.load().detail
    n_grouped = sum(map(len, result.groups))
    grades = "".join(
        f"; {counted(n, 'pair')} {grade}"
        for grade, n in Counter(copy.grade for copy in result.copies).most_common()
    )
    print(
        f"{n_grouped} of {result.n_files} files in {len(result.groups)} groups; on generated bodies, this finds "
        f"{threshold.n_found} of {threshold.n_same} pairs of copies and mistakes {threshold.n_false} of "
        f"{threshold.n_other} other pairs for copies{grades}"
    )
