"""Answers from the command line: their files and what they print are what Python computes."""

import csv
import json
import re

import numpy as np
import pytest
import trimesh
from matplotlib.image import imread
from numpy.random import default_rng

from commands import run
from igps.analysis.clusters import clusters_of
from igps.analysis.groups import group_test
from igps.analysis.map import body_map
from igps.analysis.outliers import LIMIT
from igps.data.dataset import SignatureDataset
from igps.nn.description import describe
from igps.report.figures import clusters_figure, map_figure, write_analysis
from igps.retrieval import chi_square
from label_files import write_nifti
from own_descriptors import CONFIG, SMALL, small_interior, write_egg

OWN = ["--descriptor", "own_descriptors:small_interior"]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Six short eggs and seven long ones, one of which lies among the short, with scanner and age."""
    folder = tmp_path_factory.mktemp("answers") / "meshes"
    rows = [("file", "label", "scanner", "age")]
    for label, heights in (
        ("short", (1.0, 1.1, 1.2, 1.05, 1.15, 1.25)),
        ("long", (2, 2.1, 2.2, 2.3, 2.15, 2.05, 1.12)),
    ):
        for i, height in enumerate(heights):
            write_egg(folder / f"{label}{i}.off", height, subdivisions=2)
            rows.append((f"{label}{i}.off", label, "xy"[i % 2], str(50 + i)))
    with (folder / "labels.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return folder


def igps(root, *arguments):
    cache = ["--cache_dir", root.parent / "cache"]
    run(*arguments, *cache, *SMALL)


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_groups_prints_and_writes_the_tests(root, tmp_path, capsys):
    words = [
        "--strata",
        "scanner",
        "--covariate",
        "age",
        "--test_size",
        "--n_permutations",
        "199",
        "--out",
        tmp_path,
    ]
    igps(root, "groups", root, *OWN, *words)
    printed = capsys.readouterr().out
    dataset = SignatureDataset(root, CONFIG, root.parent / "cache")
    descriptions = describe(dataset, small_interior())
    expected = group_test(
        descriptions.flatten(1).double().sqrt().numpy(),
        dataset.bodies.labels or (),
        strata=dataset.bodies.column("scanner"),
        covariates=np.array([dataset.bodies.numbers("age")]).T,
        n_permutations=199,
    )
    shape, size = json.loads((tmp_path / "groups.json").read_text())
    assert shape["body"] == "all"
    assert size["body"] == "all, size"
    assert shape["permanova_p"] == expected.permanova_p < 0.05
    assert shape["auc"] == pytest.approx(expected.auc)
    assert shape["sizes"] == "long:7 short:6"
    assert f"{expected.effect:.3f}" in printed
    assert [row["body"] for row in table(tmp_path / "groups.csv")] == ["all", "all, size"]
    assert imread(tmp_path / "groups.png").std() > 0.02
    assert (tmp_path / "groups.svg").read_text().startswith("<?xml")


def test_bodies_of_other_names_are_compared_where_each_name_is_a_group(tmp_path):
    """Of eight subjects, the right egg is longer than the left one; only as pairs are they told apart so surely."""
    place = np.indices((24, 60, 24)) - 12
    rows = ["file,body,side,subject"]
    for i in range(8):
        labels = np.zeros((24, 60, 24), dtype=np.uint8)
        for label, at, length in ((17, 0, 6 + 0.2 * i), (53, 26, 10 + 0.2 * i)):
            inside = (place[0] / 6) ** 2 + ((place[1] - at) / length) ** 2 + (
                place[2] / 6
            ) ** 2 <= 1
            labels[inside] = label
            rows.append(f"s{i}.nii.gz,{label},{'left' if label == 17 else 'right'},{i}")
        (root := tmp_path / "brains").mkdir(exist_ok=True)
        write_nifti(root / f"s{i}.nii.gz", labels)
    (root / "labels.csv").write_text("\n".join(rows))
    words = ["--group", "side", "--strata", "subject", "--out", tmp_path / "found"]
    igps(root, "groups", root, *OWN, *words)
    (found,) = json.loads((tmp_path / "found" / "groups.json").read_text())
    assert found["body"] == "all"
    assert found["sizes"] == "left:8 right:8"
    assert (
        found["permanova_p"] <= 3 / 128
    )  # the swap of all pairs does as well, and one or two may be drawn more often


@pytest.mark.parametrize("name", ["{group}{i}", "{i}", "case_{i}", "{word}"])
def test_single_masks_in_a_folder_for_each_group_are_compared(name, tmp_path):
    """Masks named by their files count as one body; volumes of the groups do not overlap, so p is nearly minimal."""
    place = np.indices((24, 24, 24)) - 12
    for group, side in (("patients", 6), ("controls", 8)):
        (folder := tmp_path / "masks" / group).mkdir(parents=True)
        for i in range(5):
            inside = (place[0] / (side + 0.2 * i)) ** 2 + (place[1] / 7) ** 2 + (
                place[2] / 7
            ) ** 2 <= 1
            word = ("ann", "bob", "cid", "dan", "eve")[i]  # before and after, of the same subjects
            path = folder / f"{name.format(group=group, i=i, word=word)}.nii.gz"
            write_nifti(path, inside.astype(np.uint8))
    words = ["--test_size", "--out", tmp_path / "found"]
    igps(tmp_path / "masks", "groups", tmp_path / "masks", *OWN, *words)
    _, size = json.loads((tmp_path / "found" / "groups.json").read_text())
    assert size["body"] == "all, size"
    assert size["sizes"] == "controls:5 patients:5"
    assert (
        size["permanova_p"] <= 6 / 252
    )  # of the 252 ways to draw five of ten, this one and its mirror


def test_volumes_are_compared_in_one_unit(tmp_path, capsys):
    """Half of the eggs of each group are in metres."""
    root = tmp_path / "eggs"
    heights = {
        "low": (1.0, 1.02, 1.04, 1.06, 1.08),
        "high": (2.0, 2.02, 2.04, 2.06, 2.08),
    }
    for label, of_each in heights.items():
        for i, height in enumerate(of_each):
            write_egg(path := root / label / f"{i}.off", height, subdivisions=2)
            if i % 2:
                trimesh.load(path, process=False).apply_scale(1e-3).export(path.with_suffix(".glb"))
                path.unlink()
    igps(root, "groups", root, *OWN, "--test_size", "--out", tmp_path)
    assert (
        "6 of 10 bodies have no unit of length; their coordinates are taken as millimetres"
        in capsys.readouterr().out
    )
    assert float(table(tmp_path / "groups.csv")[1]["effect"]) > 0.9
    igps(root, "clusters", root, *OWN, "--colour", "volume", "--out", tmp_path)
    found = {row["name"][:-4]: float(row["volume"]) for row in table(tmp_path / "clusters.csv")}
    for label, of_each in heights.items():
        for i, height in enumerate(of_each):
            assert found[f"{label}/{i}"] == pytest.approx(found["low/0"] * height, rel=1e-5)


def test_a_covariate_may_be_words_but_no_mistyped_number(root, tmp_path, capsys):
    rows = table(root / "labels.csv")
    lines = [
        f"{root / row['file']},{row['label']},{'fmm'[i % 3]},{'5o' if i == 4 else i},{'Paris' if i % 3 else 'Nantes'}"
        for i, row in enumerate(rows)
    ]
    (tmp_path / "labels.csv").write_text("\n".join(["file,label,sex,dose,site", *lines]))
    words = ["groups", tmp_path, *OWN, "--n_permutations", "199"]
    igps(root, *words, "--covariate", "sex", "--json")
    (found,) = json.loads(capsys.readouterr().out)
    descriptions = describe(SignatureDataset(root, CONFIG, root.parent / "cache"), small_interior())
    vectors = descriptions.flatten(1).double().sqrt().numpy()
    is_f = np.arange(13)[:, None] % 3 == 0
    expected = group_test(
        vectors, [row["label"] for row in rows], covariates=is_f.astype(float), n_permutations=199
    )
    assert found["permanova_f"] == pytest.approx(expected.permanova_f)
    assert found["permanova_p"] == expected.permanova_p
    # A word that begins as NaN does
    igps(root, *words, "--covariate", "site", "--json")
    assert json.loads(capsys.readouterr().out)[0]["permanova_f"] == pytest.approx(
        expected.permanova_f
    )
    with pytest.raises(SystemExit, match="1"):
        igps(root, *words, "--covariate", "dose")
    assert "dose: expected numbers, got '5o'" in capsys.readouterr().err


def test_covariates_that_are_named_one_by_one_all_count(root, capsys):
    found = []
    for words in (
        ["--covariate", "age", "scanner"],
        ["--covariate", "age", "--covariate", "scanner"],
    ):
        igps(root, "groups", root, *OWN, *words, "--n_permutations", "99", "--json")
        found.append(json.loads(capsys.readouterr().out))
    assert found[0] == found[1]


def test_groups_refuses_three_of_a_group(root, tmp_path, capsys):
    rows = table(root / "labels.csv")
    (tmp_path / "labels.csv").write_text(
        "file,ill\n"
        + "".join(
            f"{root / row['file']},{'yes' if i < 3 else 'no'}\n" for i, row in enumerate(rows)
        )
    )
    igps(root, "groups", tmp_path, "--group", "ill", *OWN, "--out", tmp_path / "out")
    assert (
        "not tested (10 no, 3 yes): yes has 3 bodies, a test needs at least 5"
        in capsys.readouterr().out
    )
    assert not (tmp_path / "out" / "groups.png").exists()


def test_outliers_lists_the_short_egg_among_the_long_first(root, tmp_path, capsys):
    igps(root, "outliers", root, *OWN, "--top", "2", "--out", tmp_path)
    printed = capsys.readouterr().out
    rows = table(tmp_path / "outliers.csv")
    assert len(rows) == 13
    assert rows[0]["name"] == "long6.off"
    assert "but nearer to short" in rows[0]["reason"]
    assert "long6.off" in printed.splitlines()[1]
    svg = (tmp_path / "outliers.svg").read_text()
    assert f"<!-- {float(rows[0]['score']):.1f}  long6.off -->" in svg
    assert str(root) not in svg
    assert [float(row["score"]) for row in rows] == sorted(
        (float(row["score"]) for row in rows), reverse=True
    )
    assert imread(tmp_path / "outliers.png").std() > 0.02
    igps(root, "outliers", root, *OWN, "--top", "0", "--out", tmp_path / "none")
    assert table(tmp_path / "none" / "outliers.csv") == rows
    assert not (tmp_path / "none" / "outliers.png").exists()


@pytest.mark.parametrize("masks", [False, True])
def test_outliers_lists_all_organs_of_a_subject_in_a_wrong_unit(masks, tmp_path):
    """The labels of a file, or the masks of a folder."""
    random = default_rng(0)
    place = np.indices((40, 14, 14)) - 6.5
    for subject in range(10):
        labels = np.zeros((40, 14, 14), dtype=np.uint8)
        for label, (x, *half) in enumerate(
            [(0, 4, 4, 4), (12, 6, 3, 3), (26, 6, 5, 3)],
            start=1,
        ):
            a, b, c = half * random.normal(1, 0.05, 3)
            labels[((place[0] - x) / a) ** 2 + (place[1] / b) ** 2 + (place[2] / c) ** 2 < 1] = (
                label
            )
        affine = np.diag([2.0, 2, 2, 1] if subject == 4 else [1.0, 1, 1, 1])
        organs = {f"s{subject}/organ{label}": labels == label for label in (1, 2, 3)}
        for name, voxels in organs.items() if masks else [(f"s{subject}", labels)]:
            (path := tmp_path / "scans" / f"{name}.nii.gz").parent.mkdir(
                parents=True, exist_ok=True
            )
            write_nifti(path, voxels.astype(np.uint8), affine)
    igps(
        tmp_path / "x",
        "outliers",
        tmp_path / "scans",
        *OWN,
        "--classes",
        "body",
        "--out",
        tmp_path,
    )
    first = table(tmp_path / "outliers.csv")[:3]
    assert [row["name"][:2] for row in first] == ["s4"] * 3
    for row in first:
        assert float(row["score"]) > LIMIT


@pytest.mark.parametrize("is_group", [False, True])
def test_explain_writes_shares_that_add_up(is_group, root, tmp_path, capsys):
    what = ["explain", root] if is_group else ["explain", root / "short0.off", root / "long3.off"]
    igps(root, *what, *OWN, "--out", tmp_path)
    printed = capsys.readouterr().out
    (part,) = table(tmp_path / "explain.csv")
    shares = [float(row["share"]) for row in table(tmp_path / "explain_samples.csv")]
    assert sum(shares) == pytest.approx(float(part["share"]), rel=1e-6)
    if is_group:
        assert "of the surface differs significantly" in printed
    else:
        assert f"short0.off and {root}/long3.off: {float(part['share']):.4g}" in printed
    assert imread(tmp_path / "explain.png").std() > 0.02


def test_explain_paints_the_voxels_in_which_an_attribute_differs(tmp_path, capsys):
    """Two equal bodies, one with a bright spot in noise: it has the share."""
    nibabel = pytest.importorskip("nibabel", reason="the extra [volumes]")
    affine = np.diag([1.0, 1.0, 1.5, 1.0])
    x, y, z = np.indices((22, 18, 14)) - np.array([10.5, 8.5, 6.5]).reshape(3, 1, 1, 1)
    label = (x / 9) ** 2 + (y / 7) ** 2 + (z / 5) ** 2 < 1
    spot = ((x - 5) ** 2 + y**2 + z**2 < 9) & label
    generator = default_rng(0)
    for name, values in (("plain", np.zeros(label.shape)), ("bright", 1.0 * spot)):
        image = (values + 0.05 * generator.normal(size=label.shape)).astype(np.float32)
        write_nifti(tmp_path / f"{name}_ct.nii.gz", image, affine)
        write_nifti(tmp_path / f"{name}.nii.gz", label.astype(np.uint8), affine)
    files = [tmp_path / "plain.nii.gz", tmp_path / "bright.nii.gz"]
    samples = ["--signature.n_eigenpairs", "50", "--signature.resolution", "14"]
    cache = ["--cache_dir", tmp_path / "cache", *SMALL, *samples, "--size", "ignore"]
    ct = ["--attribute", f"ct={tmp_path}/{{stem}}_ct.nii.gz", "--with", "ct"]
    words = ["explain", *files, *OWN, *ct, *cache, "--out", tmp_path / "out"]
    run(*words, "--json")
    told = json.loads(capsys.readouterr().out)
    rows = table(tmp_path / "out" / "explain_ct.csv")
    shares = np.array([float(row["share"]) for row in rows])
    assert shares.sum() == pytest.approx(told["attributes"]["ct"], rel=1e-6)
    found = nibabel.load(tmp_path / "out" / "explain_bright.nii.gz_bright_ct.nii.gz")
    density = found.get_fdata()
    np.testing.assert_allclose(found.affine, affine)
    assert density[spot].mean() > 4 * density[label & ~spot].mean()
    assert density[label].mean() == pytest.approx(1, abs=0.1)  # each body has half of the distance
    assert not density[~label].any()
    assert imread(tmp_path / "out" / "explain_ct.png").std() > 0.02


def test_explain_and_groups_paint_where_an_organ_differs(tmp_path, capsys):
    """Organ 1 has a knob on the patient's left in one group; organ 2 does not differ."""
    random = default_rng(0)
    world = np.stack(np.indices((32, 20, 36)), axis=-1) * 1.5 - 24.0
    rows = [("file", "diagnosis")]
    for i in range(12):
        sizes = random.uniform(0.95, 1.05, 3) * [10.0, 8.0, 9.0]
        centre = np.array([0.0, -9.0, -10.0])
        organ = (((world - centre) / sizes) ** 2).sum(axis=-1) < 1
        knob = (
            np.linalg.norm(
                world - centre - [-sizes[0], 0, 0],
                axis=-1,
            )
            < 5.5
        )
        other = (((world - [0.0, -9.0, 14.0]) / sizes) ** 2).sum(axis=-1) < 1
        labels = (organ | (knob & (i < 6))).astype(np.uint8) + 2 * other.astype(np.uint8)
        affine = np.diag([1.5, 1.5, 1.5, 1.0])
        write_nifti(tmp_path / "scans" / f"s{i}.nii.gz", labels, affine)
        rows.append((f"s{i}.nii.gz", "ill" if i < 6 else "healthy"))
    with (tmp_path / "scans" / "labels.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    what = [tmp_path / "scans", *OWN, "--group", "diagnosis", "--n_workers", 1]
    igps(tmp_path, "explain", *what, "--body", "1", "--out", tmp_path / "one")
    printed = capsys.readouterr().out
    assert "ill lies outside healthy by up to" in printed
    assert imread(tmp_path / "one" / "explain.png").std() > 0.02
    igps(tmp_path, "groups", *what, "--out", tmp_path / "all")
    assert (tmp_path / "all" / "places_1.png").is_file()
    assert not (tmp_path / "all" / "places_2.png").exists()


@pytest.mark.parametrize(
    ("largest", "told"),
    [
        (1, "half of its share lies on {}% of its surface"),
        (0, "none of the difference lies on its surface"),
    ],
)
def test_explain_tells_how_much_of_the_surface_differs(largest, told, root, monkeypatch, capsys):
    """One of 162 vertices has the whole share, whose area trimesh gives; or no vertex has a positive share."""
    body = trimesh.load(root / "long3.off", process=False)
    area = body.area_faces[(body.faces == 161).any(axis=1)].sum() / 3
    told = told.format(f"{100 * area / body.area:.2g}")
    monkeypatch.setattr(
        "igps.analysis.explanation.share_density", lambda *_: np.append(np.full(161, -1.0), largest)
    )
    igps(root, "explain", root / "short0.off", root / "long3.off", *OWN)
    assert capsys.readouterr().out.splitlines()[-1] == f"{root}/long3.off: {told}"


@pytest.mark.parametrize("is_group", [False, True])
def test_explain_heeds_size_and_side(is_group, root, capsys):
    """Bodies that are twice as large as others of their form differ in size; the side of symmetric ones is rounding."""
    folder = root.parent / f"sized{is_group}"
    for label, factor in (("small", 1.0), ("large", 2.0)):
        for i in range(6):
            egg = trimesh.creation.icosphere(subdivisions=2)
            egg.vertices *= np.array([1, 1, 1.2 + i / 50]) * factor
            (folder / label).mkdir(parents=True, exist_ok=True)
            egg.export(folder / label / f"{i}.off")
    what = [folder] if is_group else [folder / "small" / "0.off", folder / "large" / "0.off"]
    own = ["--descriptor", "own_descriptors:small_gps"]
    igps(
        root,
        "explain",
        *what,
        *own,
        "--size",
        "keep",
        "--mirror",
        "distinct",
        "--json",
    )
    found = json.loads(capsys.readouterr().out)
    shares = {row["histogram"]: row["share"] for row in found["shares"]}
    assert list(shares)[-2:] == ["side", "size"]
    assert shares["size"] > 0.5 * found["distance"]
    assert shares["size"] + shares["side"] == pytest.approx(found["distance"], rel=1e-3)
    if is_group:  # painted is the middle of each, although some of its numbers are negative
        assert {name[-5] for name in found["bodies"]} <= set("1234")


def test_explain_shows_the_ends_of_an_axis_of_the_map(root, tmp_path, capsys):
    """Eggs vary in their height alone: from the ball to the longest."""
    igps(root, "explain", root, *OWN, "--axis", 1, "--out", tmp_path)
    printed = capsys.readouterr().out
    share = re.search(
        r"axis 1 of the map has (\d+)% of the squared distances of 13 bodies", printed
    )
    assert share is not None
    assert int(share[1]) > 80
    assert len(list(tmp_path.glob("explain_*.ply"))) == 2
    assert imread(tmp_path / "explain.png").std() > 0.02
    found = {row["name"] for row in table(tmp_path / "explain_samples.csv")}
    (end, other) = sorted(found)
    assert other == "short0.off"
    assert end in {f"long{i}.off" for i in range(6)}


def test_clusters_are_the_two_kinds_of_eggs(root, tmp_path, here, capsys):
    out = ["--out", "figures"]
    igps(root, "clusters", root, *OWN, "--n_clusters", "2", *out)
    printed = capsys.readouterr().out
    rows = table(tmp_path / "figures" / "clusters.csv")
    clusters = {row["name"]: row["cluster"] for row in rows}
    assert [clusters[f"short{i}.off"] for i in range(6)] == [clusters["long6.off"]] * 6 == ["1"] * 6
    assert [clusters[f"long{i}.off"] for i in range(6)] == ["2"] * 6
    assert "6 short, 1 long" in printed
    assert "2 of 2 clusters are stable (at least 0.75)\n" in printed
    assert imread(tmp_path / "figures" / "clusters.png").std() > 0.02
    assert "long6.off" in (tmp_path / "figures" / "clusters.json").read_text()


def test_a_stability_that_was_not_measured_is_unknown(root, capsys):
    igps(root, "clusters", root, *OWN, "--n_clusters", "2", "--n_resamples", "0")
    assert "0 of 2 clusters are stable (at least 0.75), 2 unknown\n" in capsys.readouterr().out


@pytest.mark.parametrize("colour", ["class", "cluster", "volume", "age", "scanner"])
def test_the_map_has_the_distances_of_the_descriptor_and_its_colours(
    colour, root, tmp_path, capsys
):
    igps(root, "clusters", root, *OWN, "--colour", colour, "--out", tmp_path)
    rows = table(tmp_path / "clusters.csv")
    dataset = SignatureDataset(root, CONFIG, root.parent / "cache")
    found = body_map(chi_square(*2 * [describe(dataset, small_interior())]).numpy())
    assert np.array(
        [[row["x"], row["y"]] for row in rows],
        dtype=float,
    ) == pytest.approx(found.points, abs=1e-5)
    assert f"stress {found.stress:.2f}" in capsys.readouterr().out
    first = {
        "class": "short",
        "cluster": "1",
        "volume": str(dataset[0].signature.volume),
        "age": "50.0",
        "scanner": "x",
    }
    assert rows[0]["name"] == "short0.off"
    assert rows[0][colour] == first[colour]
    assert imread(tmp_path / "map.png").std() > 0.02
    assert (tmp_path / "map.svg").read_text().startswith("<?xml")


def test_a_column_called_as_the_coordinates_leaves_them_alone(root, tmp_path, capsys):
    rows = table(root / "labels.csv")
    (tmp_path / "labels.csv").write_text(
        "file,x\n" + "".join(f"{root / row['file']},7\n" for row in rows)
    )
    igps(root, "map", tmp_path, *OWN, "--colour", "x", "--out", tmp_path)
    assert "igps: map is a part of igps clusters now." in capsys.readouterr().err
    found = table(tmp_path / "clusters.csv")
    assert {row["x of labels.csv"] for row in found} == {"7.0"}
    assert len({row["x"] for row in found}) == len(rows)


def test_what_is_not_known_is_null_in_the_file(tmp_path):
    write_analysis(tmp_path, "rows", [{"body": "é", "stability": float("nan")}])
    assert json.loads((tmp_path / "rows.json").read_text(), parse_constant=pytest.fail) == [
        {"body": "é", "stability": None}
    ]
    assert table(tmp_path / "rows.csv")[0]["body"] == "é"


def test_names_are_drawn_as_they_are_and_not_as_formulas(tmp_path):
    names = ["cost_$a_{$.off", "_under", "$x$"]
    distances = np.array([[0.0, 1, 3], [1, 0, 2], [3, 2, 0]])
    figures = {
        "clusters": clusters_figure(clusters_of(distances, 2), names),
        "map": map_figure(body_map(distances), names, "$a_{$"),
    }
    for name, figure in figures.items():
        write_analysis(tmp_path, name, [{"body": "a"}], figure)
        assert imread(tmp_path / f"{name}.png").std() > 0.02
        drawn = (tmp_path / f"{name}.svg").read_text()
        for one in names:
            assert f"<!-- {one}" in drawn


@pytest.mark.filterwarnings("error")
def test_a_picture_is_the_same_each_time_and_has_room_for_long_names(tmp_path):
    distances = np.array([[0.0, 1, 3], [1, 0, 2], [3, 2, 0]])
    for folder in ("one", "other"):
        figure = clusters_figure(
            clusters_of(distances, 2), ["a", "b", "sub-01/" + "x" * 200 + ".off"]
        )
        write_analysis(tmp_path / folder, "clusters", [{"body": "a"}], figure)
        assert figure.axes[0].get_window_extent().width > 0.4 * figure.bbox.width
    one, other = ((tmp_path / folder / "clusters.svg").read_bytes() for folder in ("one", "other"))
    assert one == other
    assert "<!-- sub-01/xxx" in one.decode()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            ["clusters", "--colour", "weight"],
            "weight: no such column of labels.csv; further columns: scanner, age",
        ),
        (
            ["groups", "--group", "weight"],
            "weight: no such column of labels.csv; further columns: scanner, age",
        ),
        (["groups", "--strata", "weight"], "weight: no such column of labels.csv"),
        (["groups", "--covariate", "age", "weight"], "weight: no such column of labels.csv"),
    ],
)
def test_what_labels_do_not_tell_is_refused_before_anything_is_computed(
    command, message, root, tmp_path, capsys
):
    cache = ["--cache_dir", tmp_path / "cache"]
    where = next(i for i, word in enumerate(command) if word.startswith("--"))
    words = [
        *command[:where],
        root,
        *command[where:],
        *OWN,
        *cache,
        *SMALL,
    ]
    with pytest.raises(SystemExit, match="1"):
        run(*words)
    assert message in capsys.readouterr().err
    assert not (tmp_path / "cache").exists()


def test_three_classes_are_refused_before_anything_is_computed(tmp_path, capsys):
    for label in "abc":
        write_egg(tmp_path / "eggs" / label / "0.off", 1.0, subdivisions=2)
    words = ["explain", tmp_path / "eggs", "--cache_dir", tmp_path / "cache"]
    with pytest.raises(SystemExit, match="1"):
        run(*words)
    assert "expected a folder of two groups, got 3" in capsys.readouterr().err
    assert not (tmp_path / "cache").exists()
