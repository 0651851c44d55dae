"""Where a label reaches the border of its image, and a scan may have cut the body."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from igps.mesh.mesh import Frame
from igps.mesh.raw_body import LabelVoxels

# To where the axes of the world point, backwards and forwards: to sides of the patient if these are known
_SIDES: Mapping[Frame, tuple[tuple[str, str], ...]] = {
    "RAS": (("left", "right"), ("posterior", "anterior"), ("inferior", "superior")),
    None: (("-x", "+x"), ("-y", "+y"), ("-z", "+z")),
}
_NOTE = re.compile(r"at the border of the image \(([^)]+)\): ([\d.]+)% of the surface may be a cut")


@dataclass(frozen=True)
class Border:
    """What of a body lies on the border of its image."""

    share: float  # of the surface
    sides: str  # such as "LI" for left and inferior; "-x+z" if it is not known how the patient lies


def border_notes(voxels: LabelVoxels, area: float, frame: Frame) -> tuple[str, ...]:
    """Return a note if a label reaches the border of the image: sides, and share of the area of its surface."""
    axes = voxels.affine[:3, :3]
    is_first = voxels.low == 0
    is_last = np.equal(voxels.low + np.array(voxels.mask.shape), voxels.grid)
    sides = []
    cut_area = 0.0
    for axis in range(3):
        forward = axes[:, axis]
        first, second = np.delete(axes, axis, axis=1).T
        face_area = np.linalg.norm(np.cross(first, second))
        ends = []
        if is_first[axis]:
            ends.append((0, -forward))
        if is_last[axis]:
            ends.append((-1, forward))
        for index, outward in ends:
            n_faces = np.count_nonzero(voxels.mask.take(index, axis=axis))
            cut_area += float(n_faces * face_area)
            world_axis = int(np.argmax(np.abs(outward)))
            sides.append((world_axis, int(outward[world_axis] > 0)))
    if not sides:
        return ()
    names = ", ".join(_SIDES[frame][axis][end] for axis, end in sorted(sides))
    share = min(cut_area / area, 1.0)
    return (f"at the border of the image ({names}): {share:.2%} of the surface may be a cut",)


def border_of(notes: Iterable[str]) -> Border | None:
    """Return what the notes of a body tell of the border of its image; None if it does not reach the border.

    Example:
        >>> border_of(["at the border of the image (left, inferior): 12.50% of the surface may be a cut"])
        Border(share=0.125, sides='LI')
    """
    for note in notes:
        match = _NOTE.fullmatch(note)
        if match is not None:
            names = match[1].split(", ")
            letters = [name if name[0] in "+-" else name[0].upper() for name in names]
            return Border(float(match[2]) / 100, "".join(letters))
    return None
