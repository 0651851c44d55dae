"""Speed and memory as ratios against named baselines of the same run: `make bench [DATA=folder-of-SHREC07-meshes]`.

Each figure runs in a process of its own, so that its peak memory is its own. Without DATA meshes are generated. Ours
and the baseline are timed in turn and the best of the repetitions counts, as a shared machine only adds time.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy import sparse

import igps
from igps.geometry.coordinates import extend, winding_number
from igps.geometry.laplacian import laplacian
from igps.geometry.mesh import Mesh
from igps.geometry.reading import load_mesh
from igps.geometry.voxels import grid_axes, inside_grid, interior_samples
from igps.linalg import eigenpairs
from igps.nn.axes import InteriorDistance, Potential
from igps.nn.centres import middles
from igps.nn.hard_pairs import pair_histogram
from igps.nn.histogram import joint_histogram
from igps.nn.pair_axes import Distances, OrientedPoints

K = 250


@dataclass(frozen=True)
class Figure:
    """One line of the table: `ratio` is how many times better ours is than the baseline or the target."""

    value: float
    unit: str
    baseline: float
    baseline_name: str
    ratio: float
    note: str = ""


def timed(ours: Callable[[], object], baseline: Callable[[], object], repeat: int = 3) -> tuple[float, float]:
    """Seconds of both, the best of alternating repetitions."""
    best = [float("inf"), float("inf")]
    for _ in range(repeat):
        for i, function in enumerate((ours, baseline)):
            start = time.perf_counter()
            function()
            best[i] = min(best[i], time.perf_counter() - start)
    return best[0], best[1]


def against(
    name: str, ours: Callable[[], object], baseline: Callable[[], object], repeat: int = 3, note: str = ""
) -> Figure:
    seconds, reference = timed(ours, baseline, repeat)
    return Figure(seconds, "s", reference, name, reference / seconds, note)


def within(limit: float, seconds: float, note: str = "") -> Figure:
    return Figure(seconds, "s", limit, "target", limit / seconds, note)


def model(data: Path | None, n_vertices: int, subdivisions: int = 0) -> Mesh:
    """The SHREC'07 model, or else a generated body, of about so many vertices; then subdivided at edge midpoints."""
    start = n_vertices // 4**subdivisions
    if data is not None:
        sizes = {path: vertex_count(path) for path in sorted(data.glob("*.off"))}
        mesh = load_mesh(min(sizes, key=lambda path: abs(sizes[path] - start)))
    else:
        shape = igps.ArticulatedShapes(n_classes=2, n_per_class=1, n_vertices=start)[1]
        mesh = Mesh(shape.vertices, shape.faces, name=shape.name)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    for _ in range(subdivisions):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    return Mesh(vertices, faces, name=mesh.name)


def vertex_count(path: Path) -> int:
    with path.open() as file:
        file.readline()
        return int(file.readline().split()[0])


def by_eigsh(stiffness: sparse.csr_matrix, mass: np.ndarray, k: int = K) -> tuple[np.ndarray, np.ndarray]:
    return sparse.linalg.eigsh(stiffness.tocsc(), k + 1, sparse.diags(mass, format="csc"), sigma=-0.01 / mass.sum())


def eigen(data: Path | None, n_vertices: int, subdivisions: int = 0, repeat: int = 3, k: int = K) -> Figure:
    mesh = model(data, n_vertices, subdivisions)
    stiffness, mass = laplacian(mesh)
    spectrum = eigenpairs(stiffness, mass, k, positions=mesh.vertices)
    weighted = mass[:, None] * spectrum.eigenfunctions
    error = stiffness @ spectrum.eigenfunctions - weighted * spectrum.eigenvalues
    # Relative residual in the norm in which the problem is self-adjoint, ‖Lφ − λMφ‖ in M⁻¹ over λ.
    residual = np.sqrt(np.einsum("vk,vk->k", error, error / mass[:, None])) / spectrum.eigenvalues
    return against(
        "scipy eigsh",
        lambda: eigenpairs(stiffness, mass, k, positions=mesh.vertices),
        lambda: by_eigsh(stiffness, mass, k),
        repeat,
        f"{k} pairs, {len(mesh.vertices)} vertices, largest relative residual {residual.max():.1e}",
    )


def eigen_against_lapy(data: Path | None) -> Figure:
    from lapy import Solver, TriaMesh

    mesh = model(data, 11_000)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)

    def ours() -> None:
        stiffness, mass = laplacian(mesh)
        eigenpairs(stiffness, mass, K, positions=mesh.vertices)

    return against("LaPy", ours, lambda: Solver(TriaMesh(vertices, faces)).eigs(K + 1), note="matrices and eigenpairs")


def eigen_against_robust(data: Path | None) -> Figure:
    import robust_laplacian

    mesh = model(data, 11_000)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)

    def ours() -> None:
        stiffness, mass = laplacian(mesh, "robust")
        eigenpairs(stiffness, mass, K, positions=mesh.vertices)

    def theirs() -> None:
        stiffness, mass = robust_laplacian.mesh_laplacian(vertices, faces)
        by_eigsh(stiffness.tocsr(), mass.diagonal())

    return against("robust-laplacian + eigsh", ours, theirs, note="intrinsic-Delaunay matrices and eigenpairs")


def coordinates_25k(data: Path | None) -> Figure:
    mesh = model(data, 25_273)
    stiffness, mass = laplacian(mesh)
    spectrum = eigenpairs(stiffness, mass, K, positions=mesh.vertices)
    points = interior_samples(mesh)

    def evaluate(accuracy: float | None) -> np.ndarray:
        return extend(mesh.vertices, mesh.faces, spectrum.eigenfunctions, points, accuracy=accuracy)

    embedding = [torch.from_numpy(evaluate(a) / np.sqrt(spectrum.eigenvalues)) for a in (None, 1e-3)]
    exact, hybrid = (torch.pdist(e) for e in embedding)
    error = torch.quantile(((hybrid - exact).abs() / exact)[:: len(exact) // 1_000_000 + 1], 0.99)
    note = f"{len(points)} samples, 99 % of interior distances within {error:.1e}"
    return against("our exact evaluation", lambda: evaluate(1e-3), lambda: evaluate(None), 2, note)


def voxels_128(data: Path | None) -> Figure:
    import igl

    mesh = model(data, 25_273)
    axes = grid_axes(mesh, 128)
    count = int(np.prod([len(axis) for axis in axes]))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)[:: count // 2000]
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    seconds, sample = timed(lambda: inside_grid(mesh, axes), lambda: igl.winding_number(vertices, faces, points))
    reference = sample * count / len(points)
    note = f"{len(mesh.faces)} faces, {count} cells; the baseline scaled up from {len(points)} cells"
    return Figure(seconds, "s", reference, "libigl winding number", reference / seconds, note)


def winding_25k(data: Path | None) -> Figure:
    import igl

    mesh = model(data, 25_273)
    points = interior_samples(mesh)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    return against(
        "libigl winding number",
        lambda: winding_number(mesh.vertices, mesh.faces, points),
        lambda: igl.winding_number(vertices, faces, points),
        note=f"exact, at {len(points)} scattered points",
    )


def histogram_pairs(data: Path | None) -> Figure:
    embedding = torch.randn(4096, K, generator=torch.Generator().manual_seed(0)) * 0.06
    potential = embedding.norm(dim=1)

    def plain() -> torch.Tensor:
        return torch.histc(torch.pdist(embedding), 64, 0, 4)

    seconds, reference = timed(lambda: pair_histogram(embedding, potential), plain, 5)
    pairs = len(embedding) * (len(embedding) - 1) / 2e6
    note = "baseline: distances alone and one hard histogram, no classes"
    return Figure(pairs / seconds, "M pairs/s", pairs / reference, "torch pdist + histc", reference / seconds, note)


def histogram_backward(data: Path | None) -> Figure:
    embedding = torch.randn(4096, K, generator=torch.Generator().manual_seed(0)) * 0.06
    potential = embedding.norm(dim=1)
    classes, bins = Potential(4, learnable=True), InteriorDistance(64, learnable=True)
    upstream = torch.randn(10, 64, generator=torch.Generator().manual_seed(1))
    centres = torch.linspace(0.03, 3.97, 64, requires_grad=True)
    small = embedding[:1024]

    def ours() -> None:
        distances = Distances(embedding, bins.centres(), equal=False)
        (joint_histogram(classes.memberships(potential), [distances]) * upstream).sum().backward()

    def by_autograd() -> None:
        # The same kernel without classes, as autograd runs it: all (pairs, bins) at once, for a sixteenth of the pairs.
        position = torch.pdist(small)[:, None] - centres
        (torch.relu(1 - position.abs() * 16).sum(dim=0) * upstream[0]).sum().backward()

    seconds, reference = timed(ours, by_autograd, 5)
    rate = 4096 * 4095 / 2e6 / seconds
    reference = 1024 * 1023 / 2e6 / reference
    note = "forward and backward to all centres, soft classes; baseline: one class, 1,024 points"
    return Figure(rate, "M pairs/s", reference, "dense autograd", rate / reference, note)


def oriented_pairs(data: Path | None) -> Figure:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(1000, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(1000, 3, generator=generator), dim=1)
    one_class = torch.ones(1000, 1)
    distances = Distances(points, middles(6, 1.0, "bins"), equal=True)
    cosines = middles(5, 2.0, "bins") - 1
    oriented = OrientedPoints(points, directions, cosines, cosines)
    x, n = points.double().numpy(), directions.double().numpy()
    i, j = np.triu_indices(1000, 1)

    def ours() -> None:
        with torch.inference_mode():
            joint_histogram(one_class, [distances, oriented])

    def by_numpy() -> None:
        line = x[j] - x[i]
        distance = np.linalg.norm(line, axis=1)
        a, b = ((sign * n[end] * line).sum(axis=1) / distance for sign, end in ((1, i), (-1, j)))
        features = np.stack([distance, np.maximum(a, b), np.minimum(a, b), (n[i] * n[j]).sum(axis=1)], axis=1)
        np.histogramdd(features, (6, 5, 5, 5), [(0, 1), (-1, 1), (-1, 1), (-1, 1)])

    seconds, reference = timed(ours, by_numpy, 5)
    pairs = len(i) / 1e6
    note = "four linear kernels, differentiable; baseline: nearest bins"
    return Figure(pairs / seconds, "M pairs/s", pairs / reference, "numpy histogramdd", reference / seconds, note)


def descriptor_15k(data: Path | None) -> Figure:
    """Peak memory beside the library itself, for a body of 15,000 samples: 112 million pairs."""
    embedding = torch.randn(15_000, K, generator=torch.Generator().manual_seed(0)) * 0.06
    potential = embedding.norm(dim=1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    pair_histogram(embedding, potential)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20 - before
    return Figure(grown, "GiB", 1.0, "target", 1.0 / max(grown, 1e-3), "memory beyond the embedding's own 14 MiB")


def mesh_to_histogram(mesh: Mesh) -> float:
    start = time.perf_counter()
    signature = igps.compute_signature(mesh, igps.SignatureConfig.paper())
    igps.descriptor("interior")(igps.collate([signature]))
    return time.perf_counter() - start


def mesh_10k(data: Path | None) -> Figure:
    mesh = model(data, 10_000)
    note = f"{len(mesh.vertices)} vertices; the paper reports about 200 s on its machine"
    return within(1.5, min(mesh_to_histogram(mesh) for _ in range(3)), note)


def mesh_250k(data: Path | None) -> Figure:
    mesh = model(data, 250_000, 2)
    return within(90, mesh_to_histogram(mesh), f"{len(mesh.vertices)} vertices")


def shrec07(data: Path | None) -> dict[str, Figure]:
    """All models to the table, from nothing and from the cache, by the command line."""
    if data is None:
        return {}
    with tempfile.TemporaryDirectory() as cache:
        seconds = []
        for _ in range(2):
            start = time.perf_counter()
            command = [sys.executable, "-m", "igps.cli", "retrieve", str(data), "--paper", "--cache_dir", cache]
            subprocess.run(command, check=True, capture_output=True)
            seconds.append(time.perf_counter() - start)
    return {"shrec07_cold": within(480, seconds[0]), "shrec07_warm": within(45, seconds[1])}


FIGURES: dict[str, Callable[[Path | None], Figure | dict[str, Figure]]] = {
    "eigen_11k": lambda data: eigen(data, 11_000),
    "eigen_25k": lambda data: eigen(data, 25_273),
    "eigen_100k": lambda data: eigen(data, 101_092, 1, repeat=1),
    "eigen_64_11k": lambda data: eigen(data, 11_000, k=64),
    "eigen_64_25k": lambda data: eigen(data, 25_273, k=64),
    "eigen_11k_lapy": eigen_against_lapy,
    "eigen_11k_robust": eigen_against_robust,
    "coordinates_25k": coordinates_25k,
    "winding_25k": winding_25k,
    "voxels_128": voxels_128,
    "histogram_pairs": histogram_pairs,
    "histogram_backward": histogram_backward,
    "oriented_pairs": oriented_pairs,
    "descriptor_15k": descriptor_15k,
    "mesh_10k": mesh_10k,
    "mesh_250k": mesh_250k,
    "shrec07": shrec07,
}


def run_one(name: str, data: Path | None) -> None:
    result = FIGURES[name](data)
    figures = result if isinstance(result, dict) else {name: result}
    who = resource.RUSAGE_CHILDREN if name == "shrec07" else resource.RUSAGE_SELF
    peak = resource.getrusage(who).ru_maxrss / 2**20
    print(json.dumps({key: {**asdict(figure), "peak_gib": peak} for key, figure in figures.items()}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of the SHREC'07 meshes")
    parser.add_argument("--out", type=Path, default=Path("build/bench.json"))
    parser.add_argument("--only", nargs="+", choices=FIGURES, default=list(FIGURES))
    parser.add_argument("--here", choices=FIGURES, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        run_one(options.here, options.data)
        return
    table: dict[str, dict[str, float | str]] = {}
    print(f"{'figure':<18}{'value':>10} {'unit':<10}{'baseline':>10}  {'ratio':>7}  {'peak':>9}  baseline; note")
    for name in options.only:
        command = [sys.executable, __file__, "--here", name]
        command += ["--data", str(options.data)] if options.data else []
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        for key, row in json.loads(output.splitlines()[-1]).items():
            table[key] = row
            print(
                f"{key:<18}{row['value']:>10.3g} {row['unit']:<10}{row['baseline']:>10.3g}  {row['ratio']:>6.1f}×  "
                f"{row['peak_gib']:>5.2f} GiB  {row['baseline_name']}; {row['note']}",
                flush=True,
            )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(table, indent=2) + "\n")
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
