"""The figures of Rustamov 2010: `python -m training.study figure {pose,topology,potential}`."""

from pathlib import Path
from typing import Any

import numpy as np

from igps._arrays import Singles
from igps.cli.reading import signatures
from igps.data.sources import find_bodies
from igps.mesh.loading import load_mesh
from igps.mesh.mending import Mending
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from training.studies.paper import pose_curves, potential_slice, weld_change


def pose(root: Path, classes: list[str] | None = None, out: Path = Path("pose.png"), **reading: Any) -> dict[str, Any]:
    """Draw the distribution of interior distances of every mesh of some classes (Rustamov 2010, figure 1).

    One potential class, 64 bins, one curve a mesh, one colour a class: the poses of one body lie together, other bodies
    apart. Prints the median chi-square distance between meshes of a class, and from them to those of the others.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        classes: which to draw; all if not given.
        out: the picture, a PNG file.
    """
    files = find_bodies(root, labelled=True)
    labels = files.labels or ()
    known = sorted(set(labels))
    classes = classes or known
    unknown = [name for name in classes if name not in known]
    if unknown:
        raise ValueError(f"classes: {root} has no class {unknown[0]}. It has {', '.join(known)}.")
    chosen = files.subset([i for i, label in enumerate(labels) if label in classes])
    dataset, failures = signatures(chosen, **reading)
    found = pose_curves(dataset, classes)

    from training.studies.paper_figures import draw_pose_curves

    draw_pose_curves(found.curves, found.centres, out)
    width = max(len(name) for name in found.curves)
    print(f"{'class':<{width}}  meshes  within  to others   median chi-square distance of the curves")
    for name, curves in found.curves.items():
        within, to_others = _median(found.within[name]), _median(found.to_others[name])
        print(f"{name:<{width}}  {len(curves):>6}  {within}  {to_others:>9}")
    if failures:
        print(f"{len(failures)} meshes could not be used.")
    print(f"written to {out}")
    return {
        name: {
            "n_meshes": len(curves),
            "within": float(np.median(found.within[name])) if found.within[name].size else None,
            "to_others": float(np.median(found.to_others[name])) if found.to_others[name].size else None,
        }
        for name, curves in found.curves.items()
    }


def topology(
    mesh: Path,
    weld: list[int] | None = None,
    out: Path = Path("topology.png"),
    n_eigenpairs: int = 250,
    resolution: int = 32,
    mend: Mending = "auto",
) -> dict[str, Any]:
    """Weld two places of a body, and draw how its interior distances change (Rustamov 2010, figure 2).

    The weld is a triangular tube between two vertices, which adds one to the genus. The distances are those between the
    same interior samples before and after.

    Args:
        mesh: the body.
        weld: indices of the two vertices, from 0; if not given, two that face each other across a narrow gap and are
            far apart along the surface.
        out: the picture, a PNG file.
        n_eigenpairs: eigenpairs of the embedding; 250 in the paper.
        resolution: voxels along the longest side, one sample each; 32 in the paper.
        mend: auto does the least that makes a body of the mesh, never refuses what is no body, always makes it
            watertight unless it bounds one body without crossing itself.
    """
    if weld is not None and len(weld) != 2:
        raise ValueError(f"weld: expected the indices of two vertices, got {len(weld)}.")
    ends = None if weld is None else (weld[0], weld[1])
    found = weld_change(load_mesh(mesh, LoadOptions(mend)), ends, n_eigenpairs, resolution, progress=True)

    from training.studies.paper_figures import draw_weld_change

    draw_weld_change(found.before, found.after, found.change, out)
    print(found.after.notes[-1])
    print(f"genus {found.before.genus} before, {found.after.genus} after")
    print(f"{found.n_samples} interior samples, {len(found.change)} pairs, {n_eigenpairs} eigenpairs")
    for limit, reported in ((3, "99.6 %"), (10, None), (14, "all")):
        beside = f" (Rustamov 2010, for Homer: {reported})" if reported else ""
        share = 100 * np.mean(found.change < limit / 100)
        print(f"changed by less than {limit:>2} %: {share:.1f} % of the pairs{beside}")
    print(f"largest change: {100 * found.change.max():.1f} % (Rustamov 2010, for Homer: at most 14 %)")
    for when, values in zip(("before", "after"), found.eigenvalues, strict=True):
        print(f"first eigenvalues {when}: " + ", ".join(f"{value:.4g}" for value in values[:3]))
    print(f"written to {out}")
    return {
        "genus": [one.genus for one in (found.before, found.after)],
        "n_samples": found.n_samples,
        "changed_below": {str(limit / 100): float(np.mean(found.change < limit / 100)) for limit in (3, 10, 14)},
        "largest_change": float(found.change.max()),
        "first_eigenvalues": [values[:3].tolist() for values in found.eigenvalues],
    }


def potential(
    mesh: Path,
    out: Path = Path("potential.png"),
    n_eigenpairs: int = 250,
    resolution: int = 32,
    mend: Mending = "auto",
) -> dict[str, Any]:
    """Draw the barycentroid potential of a body on a plane through its barycentroid (Rustamov 2010, section 4).

    The plane is spanned by the two longest principal axes of the vertices.

    Args:
        mesh: the body.
        out: the picture, a PNG file.
        n_eigenpairs: eigenpairs of the embedding; 250 in the paper.
        resolution: voxels along the longest side, near the best of which the barycentroid is searched; 32 in the paper.
        mend: auto does the least that makes a body of the mesh, never refuses what is no body, always makes it
            watertight unless it bounds one body without crossing itself.
    """
    from training.studies.paper_figures import draw_potential_slice, upright

    body = load_mesh(mesh, LoadOptions(mend))
    body = Mesh(upright(body.vertices), body.faces, name=body.name)
    found = potential_slice(body, n_eigenpairs, resolution, progress=True)
    draw_potential_slice(found.axes, found.values, found.section, found.barycentroid, out)
    print(f"{found.n_samples} interior samples, {n_eigenpairs} eigenpairs")
    print(f"potential {found.least:.4f} at the barycentroid, up to {found.largest:.4f} at the samples")
    print(f"written to {out}")
    return {"n_samples": found.n_samples, "least": found.least, "largest": found.largest}


def _median(values: Singles) -> str:
    return f"{np.median(values):6.3f}" if values.size else f"{'-':>6}"
