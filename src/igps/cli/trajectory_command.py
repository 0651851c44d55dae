"""The command `igps trajectory`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from igps._parameters import check_at_least
from igps.signature.config import SignatureConfig

# A fifth of the time of the default, as frames are many. Distances between 7 frames of a kinase correlate by 0.996 with
# those of full surfaces.
FRAME = SignatureConfig(max_vertices=700, resolution=20, min_samples=500)


def trajectory(
    files: list[Path],
    out: Path,
    descriptor: str = "rich",
    select: str = "protein or nucleic",
    step: int = 1,
    signature: SignatureConfig = FRAME,
    **describing: Any,
) -> list[dict[str, Any]]:
    """Draw a map of the frames of a simulation, in which similar conformations lie close together.

    The frames are written as PQR files into the folder `frames` of `out`, without hydrogens, whose charges their
    neighbours have. All other commands read them too. It needs MDAnalysis. Unless options of signatures are given,
    these are coarser than elsewhere, with 700 vertices.

    Args:
        files: the topology, such as a PSF or PDB file, and one or several files of frames, such as DCD or XTC.
        out: folder for the frames, trajectory.csv, trajectory.json, trajectory.svg and trajectory.png.
        select: atoms, in the language of MDAnalysis; by default proteins and nucleic acids.
        step: take every so many frames.
    """
    import numpy as np

    from igps.analysis.comparison import pair_distances
    from igps.analysis.map import body_map
    from igps.cli.reading import check_files, described
    from igps.fields.molecules.trajectories import write_frames
    from igps.report.figures import map_figure, write_analysis

    check_at_least(1, step=step)
    if len(files) < 2:
        raise ValueError("files: expected a topology and a file of frames, got one file.")
    check_files(files)
    written = write_frames(files[0], files[1:], out / "frames", select, step)
    frame_of = {path: (number, time) for path, number, time in written}
    reading = {"bodies": "whole", "signature": signature, **describing}
    result = described([path for path, _, _ in written], descriptor, **reading)
    n_frames = len(result.dataset)
    if n_frames < 3:
        raise ValueError(f"files: expected three frames for a map, got {n_frames}. Reduce --step.")
    distances = pair_distances(result.descriptor, result.descriptions).double().numpy()
    layout = body_map(distances)
    rows = []
    for path, place, away in zip(
        result.dataset.bodies.paths, layout.points.tolist(), distances[0], strict=True
    ):
        number, time = frame_of[path]
        numbers = {"frame": number, "time": time, "x": place[0], "y": place[1]}
        rows.append({**numbers, "distance_to_first": float(away)})
    farthest = rows[int(np.argmax(distances[0]))]
    print(
        f"{n_frames} frames; farthest from the first: frame {farthest['frame']}, "
        f"{farthest['distance_to_first']:.3g} by {result.descriptor.name}; stress {layout.stress:.2f}"
    )
    figure = map_figure(layout, [float(row["frame"]) for row in rows], "frame")
    write_analysis(out, "trajectory", rows, figure)
    print(f"written to {out}")
    return rows
