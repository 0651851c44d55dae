"""The rows of plain numbers that stand beside a claim."""

import numpy as np
import pytest
import trimesh

import igps
from igps.analysis.plain_numbers import plain_scores
from igps.descriptors.measures import Measures
from igps.report.tables import plain_table
from igps.retrieval import retrieval_scores

SPHERE = trimesh.creation.icosphere(subdivisions=3)


def test_size_alone_tells_small_balls_from_large_ones_and_the_table_says_so(tmp_path):
    bodies = {}
    labels = []
    generator = np.random.default_rng(0)
    for i in range(8):
        is_large = i % 2
        sides = np.exp(0.05 * generator.normal(size=3)) * (10 if is_large else 1)
        bodies[f"{i}"] = igps.Mesh(
            SPHERE.vertices * sides,
            SPHERE.faces,
            unit="mm",
        )
        labels.append("large" if is_large else "small")
    dataset = igps.SignatureDataset(
        bodies, descriptor=Measures(), cache_dir=tmp_path, labels=labels
    )
    dataset.precompute(n_workers=1, progress=False)
    rows = plain_scores(dataset)
    assert list(rows) == ["measures", "measures+size"]
    assert rows["measures+size"].mean()["ft"] == 1
    assert rows["measures"].mean()["ft"] < 0.9
    table = plain_table(rows, "pretrained", rows["measures"])
    assert "measures+size  100.0  100.0  100.0" in table
    assert "measures, measures+size find these classes as well as pretrained or better" in table
    sized = {"measures+size": rows["measures+size"]}
    table = plain_table(sized, "pretrained", rows["measures"])
    assert "measures+size finds these classes" in table


def test_molecules_have_rows_of_composition_and_length(tmp_path):
    pytest.importorskip("gemmi", reason="the extra [molecules]")
    names = {
        "a": ["ALA", "GLY"] * 6,
        "b": ["ALA", "GLY"] * 6,
        "c": ["LEU"] * 12,
        "d": ["LEU"] * 12,
    }
    for file, residues in names.items():
        lines = []
        for i, residue in enumerate(residues):
            x = 2.3 * np.cos(1.75 * i)
            y = 2.3 * np.sin(1.75 * i)
            z = 1.5 * i
            place = f"{x:8.3f}{y:8.3f}{z:8.3f}"
            lines.append(
                f"ATOM  {i + 1:5d}  CA  {residue} A{i + 1:4d}    {place}  1.00  0.00           C"
            )
        (tmp_path / f"{file}.pdb").write_text("\n".join([*lines, "END\n"]))
    composition = igps.descriptor("composition")
    dataset = igps.SignatureDataset(
        sorted(tmp_path.glob("*.pdb")),
        descriptor=composition,
        cache_dir=tmp_path / "cache",
        labels=["ag", "ag", "l", "l"],
    )
    dataset.precompute(n_workers=1, progress=False, strict=True)
    described = igps.describe(dataset, composition, n_workers=1)
    assert described[:, 0].tolist() == [0.5, 0.5, 0, 0]  # alanine
    distances = composition.distances(described, described)
    assert retrieval_scores(distances, ["ag", "ag", "l", "l"]).mean()["nn"] == 1
    rows = plain_scores(dataset)
    assert rows["composition"].mean()["ft"] == 1
    assert rows["length of chain"].n_queries == 4
