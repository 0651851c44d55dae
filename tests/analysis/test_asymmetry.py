"""Left and right are paired by their names, and pairs that differ more than others' come first."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from commands import error_of, run
from igps.analysis.asymmetry import asymmetries, find_pairs
from igps.data.sources import Bodies
from igps.mesh.loading import BodyRef
from label_files import write_nifti


def bodies_called(names):
    """Bodies of files FILE and of parts FILE#PART."""
    split = [name.partition("#") for name in names]
    refs = tuple(BodyRef(Path(file), part or None) for file, _, part in split)
    return Bodies(refs, tuple(names))


@pytest.mark.parametrize(
    ("left", "right", "subject", "structure"),
    [
        ("s1.nii.gz#kidney_left", "s1.nii.gz#kidney_right", "s1.nii.gz", "kidney"),
        ("s1.mgz#Left-Hippocampus", "s1.mgz#Right-Hippocampus", "s1.mgz", "Hippocampus"),
        ("s1.mgz#ctx-lh-insula", "s1.mgz#ctx-rh-insula", "s1.mgz", "ctx_insula"),
        ("s1.nii#rib_left_1", "s1.nii#rib_right_1", "s1.nii", "rib_1"),
        ("s1.nii#hip L", "s1.nii#hip R", "s1.nii", "hip"),
        ("s1/hip_left.nii#hip_left", "s1/hip_right.nii#hip_right", "s1", "hip"),
        ("left/7.ply", "right/7.ply", "7.ply", "all"),
        ("s1/lh.pial", "s1/rh.pial", "s1", "pial"),
    ],
)
def test_names_that_differ_by_a_side_alone_are_a_pair(left, right, subject, structure):
    names = (right, "s1.nii.gz#liver", "s1.nii.gz#leftover", left)
    (pair,) = find_pairs(bodies_called(names))
    assert pair.subject == subject
    assert pair.structure == structure
    assert pair.left == 3
    assert pair.right == 0


def test_files_that_are_named_by_their_sides_are_pairs_of_their_subjects():
    names = ("1_left.ply", "1_right.ply", "2_left.ply", "2_right.ply", "3_left.ply")
    pairs = find_pairs(bodies_called(names))
    assert [(pair.structure, pair.left, pair.right) for pair in pairs] == [
        ("all", 0, 1),
        ("all", 2, 3),
    ]
    assert pairs[0].subject != pairs[1].subject


class Places(torch.nn.Module):
    """Stands for a descriptor: bodies are points, and distances are between these."""

    def distances(self, queries, gallery):
        return torch.cdist(queries, gallery)


def test_the_odd_pair_comes_first_and_cut_ones_are_not_judged():
    """Eight subjects with two structures; one pair differs in form, one in size, and one is cut."""
    random = np.random.default_rng(0)
    names = [
        f"s{i}.nii#{organ}_{side}"
        for i in range(8)
        for organ in ("kidney", "hip")
        for side in ("left", "right")
    ]
    pairs = find_pairs(bodies_called(names))
    assert len(pairs) == 16
    places = random.normal(size=(32, 3))
    places[1::2] = places[::2] + 0.1 * (1 + 0.05 * random.normal(size=(16, 1)))
    places[names.index("s3.nii#hip_right")] += 0.5
    volumes = 100 * (1 + 0.01 * random.normal(size=32))
    volumes[names.index("s5.nii#kidney_left")] *= 1.5
    cut = np.array([name == "s6.nii#hip_left" for name in names])
    places[cut] += 9
    found = asymmetries(pairs, Places(), torch.from_numpy(places), volumes, cut.tolist())
    first, second, *others, last = found
    assert first.pair.subject == "s3.nii"
    assert first.pair.structure == "hip"
    assert first.form_score > 3.5 > first.size_score
    distance = np.linalg.norm(places[first.pair.left] - places[first.pair.right])
    assert first.form == pytest.approx(distance)
    assert second.pair.subject == "s5.nii"
    assert second.pair.structure == "kidney"
    assert second.size_score > 3.5 > second.form_score
    left, right = volumes[second.pair.left], volumes[second.pair.right]
    assert second.size == pytest.approx((left - right) / ((left + right) / 2))
    assert max(one.score for one in others) < 3.5
    assert last.pair.subject == "s6.nii"
    assert last.score is None


def test_the_command_finds_the_subject_whose_kidney_is_flat(tmp_path, capsys):
    """Six subjects; a right kidney is the mirror image of the left one, but for a few percent of each axis."""
    x, y, z = np.indices((20, 20, 24)) - np.array([9.5, 9.5, 11.5]).reshape(3, 1, 1, 1)
    random = np.random.default_rng(0)

    def kidney(axes):
        a, b, c = axes * random.uniform(0.96, 1.04, 3)
        twisted = x - y * z / 20
        return (twisted / 6 / a) ** 2 + (y / 7 / b) ** 2 + (z / 10 / c) ** 2 < 1

    (folder := tmp_path / "subjects").mkdir()
    for subject in range(6):
        axes = random.uniform(0.95, 1.05, 3)
        left = kidney(axes)
        right = kidney(axes * [1, 0.5 if subject == 4 else 1, 1])[::-1]
        labels = np.concatenate([right * 2, left * 3]).astype(np.uint8)
        write_nifti(folder / f"s{subject}.nii.gz", labels)
    words = ["--descriptor", "own_descriptors:small_interior", "--cache_dir", tmp_path / "cache"]
    words += ["--signature.n_eigenpairs", 20, "--n_workers", 1]
    named = ["--names", "totalsegmentator"]
    run("asymmetry", folder, "--out", tmp_path / "out", *named, *words)
    table = pd.read_csv(tmp_path / "out" / "asymmetry.csv")
    assert table["subject"][0] == "s4.nii.gz"
    assert table["form_score"][0] > 2 > table["form_score"][1:].max()
    assert table["size_score"][0] > 3.5 > table["size_score"][1:].max()
    assert table["size"][0] > 0.3 > 2 * table["size"][1:].abs().max()
    assert table["form"][1:].max() < 0.3 * table["form"][0]
    assert set(table["structure"]) == {"kidney"}
    assert "s4.nii.gz kidney" in capsys.readouterr().out.splitlines()[1]
    line = error_of(capsys, "asymmetry", folder, *words)
    assert "no body has a partner on the other side by its name" in line
