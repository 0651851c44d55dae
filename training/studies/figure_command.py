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


def pose(
    root: Path, classes: list[str] | None = None, out: Path = Path("pose.png"), **reading: Any
) -> dict[str, Any]:
    """Draw the distribution of interior distances of every mesh of some classes (Rustamov 2010, figure 1).

    Histograms have one potential class and 64 bins. There is one curve for each mesh, and one colour for each class.
    Poses of the same body have similar curves, other bodies different ones. The median chi-square distances within and
    between classes are printed.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        classes: classes to draw; all if not given.
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
    result = pose_curves(dataset, classes)

    from training.studies.paper_figures import draw_pose_curves

    draw_pose_curves(result.curves, result.centres, out)
    width = max(len(name) for name in result.curves)
    print(
        f"{'class':<{width}}  meshes  within  to others   median chi-square distance of the curves"
    )
    for name, curves in result.curves.items():
        within, to_others = _median(result.within[name]), _median(result.to_others[name])
        print(f"{name:<{width}}  {len(curves):>6}  {within}  {to_others:>9}")
    if failures:
        print(f"{len(failures)} meshes could not be used.")
    print(f"written to {out}")
    return {
        name: {
            "n_meshes": len(curves),
            "within": float(np.median(result.within[name])) if result.within[name].size else None,
            "to_others": float(np.median(result.to_others[name]))
            if result.to_others[name].size
            else None,
        }
        for name, curves in result.curves.items()
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

    The weld is a triangular tube between two vertices, which adds one to the genus. Distances between the same interior
    samples are compared before and after the weld.

    Args:
        mesh: the body.
        weld: indices of the two vertices, from 0; if not given, two that face each other across a narrow gap and are
            far apart along the surface.
        out: the picture, a PNG file.
        n_eigenpairs: eigenpairs of the embedding; 250 in the paper.
        resolution: voxels along the longest side, with one sample each; 32 in the paper.
        mend: auto makes the smallest changes that turn the mesh into a body, never refuses meshes that are no body,
            always makes the mesh watertight unless it bounds one body without crossing itself.
    """
    if weld is not None and len(weld) != 2:
        raise ValueError(f"weld: expected the indices of two vertices, got {len(weld)}.")
    ends = None if weld is None else (weld[0], weld[1])
    result = weld_change(
        load_mesh(mesh, LoadOptions(mend)), ends, n_eigenpairs, resolution, progress=True
    )

    from training.studies.paper_figures import draw_weld_change

    draw_weld_change(result.before, result.after, result.change, out)
    print(result.after.notes[-1])
    print(f"genus {result.before.genus} before, {result.after.genus} after")
    print(
        f"{result.n_samples} interior samples, {len(result.change)} pairs, {n_eigenpairs} eigenpairs"
    )
    for limit, reported in ((3, "99.6 %"), (10, None), (14, "all")):
        beside = f" (Rustamov 2010, for Homer: {reported})" if reported else ""
        share = 100 * np.mean(result.change < limit / 100)
        print(f"changed by less than {limit:>2} %: {share:.1f} % of the pairs{beside}")
    print(
        f"largest change: {100 * result.change.max():.1f} % (Rustamov 2010, for Homer: at most 14 %)"
    )
    for when, values in zip(("before", "after"), result.eigenvalues, strict=True):
        print(f"first eigenvalues {when}: " + ", ".join(f"{value:.4g}" for value in values[:3]))
    print(f"written to {out}")
    return {
        "genus": [result.before.genus, result.after.genus],
        "n_samples": result.n_samples,
        "changed_below": {
            str(limit / 100): float(np.mean(result.change < limit / 100)) for limit in (3, 10, 14)
        },
        "largest_change": float(result.change.max()),
        "first_eigenvalues": [values[:3].tolist() for values in result.eigenvalues],
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
        resolution: voxels along the longest side; the barycentroid is searched near the best of them; 32 in the paper.
        mend: auto makes the smallest changes that turn the mesh into a body, never refuses meshes that are no body,
            always makes the mesh watertight unless it bounds one body without crossing itself.
    """
    from training.studies.paper_figures import draw_potential_slice, upright

    body = load_mesh(mesh, LoadOptions(mend))
    body = Mesh(upright(body.vertices), body.faces, name=body.name)
    result = potential_slice(body, n_eigenpairs, resolution, progress=True)
    draw_potential_slice(result.axes, result.values, result.section, result.barycentroid, out)
    print(f"{result.n_samples} interior samples, {n_eigenpairs} eigenpairs")
    print(
        f"potential {result.least:.4f} at the barycentroid, up to {result.largest:.4f} at the samples"
    )
    print(f"written to {out}")
    return {"n_samples": result.n_samples, "least": result.least, "largest": result.largest}


def _median(values: Singles) -> str:
    return f"{np.median(values):6.3f}" if values.size else f"{'-':>6}"
