"""`igps extract` writes a row for each body, or for each file, that pandas reads back."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from commands import run
from igps.signature.measures import POWERS
from label_files import write_nifti
from own_descriptors import SMALL

nibabel = pytest.importorskip("nibabel", reason="the extra [volumes]")
INTERIOR = "own_descriptors:small_interior"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two subjects with a liver and a spleen of voxels of 2 mm; the second has seven voxels of a heart as well."""
    folder = tmp_path_factory.mktemp("subjects")
    index = np.indices((24, 20, 20))
    for i in (1, 2):
        labels = np.zeros((24, 20, 20), dtype=np.uint8)
        labels[
            ((index - np.array([6, 9, 9]).reshape(3, 1, 1, 1)) ** 2).sum(axis=0) < 20 + 6 * i
        ] = 1
        labels[14:20, 5:12, 5 : 14 + i] = 2
        labels[22, 2:9, 2] = 3 * (i == 2)
        write_nifti(folder / f"{i}.nii.gz", labels, np.diag([2.0, 2, 2, 1]))
        (folder / f"{i}.csv").write_text("label,name\n1,liver\n2,spleen\n3,heart\n")
    (folder / "labels.csv").write_text("file,age,body,label\n1.nii.gz,40,,well\n2.nii.gz,,,ill\n")
    return folder


def extract(root, out, *options):
    cache = ["--cache_dir", str(root.parent / "cache"), "--n_workers", "1"]
    words = ["extract", root, "--out", out, "--descriptor", INTERIOR]
    run(*words, *SMALL, *cache, *options)


def test_a_row_for_each_body_tells_what_is_known_of_it(root, tmp_path, capsys):
    extract(root, tmp_path / "features.csv")
    printed = capsys.readouterr().out
    assert "4 bodies written to" in printed
    assert "compare it by igps.descriptor(" in printed
    table = pd.read_csv(tmp_path / "features.csv", dtype={"age": str}, keep_default_na=False)
    assert table["name"].tolist() == [
        "1.nii.gz#liver",
        "1.nii.gz#spleen",
        "2.nii.gz#liver",
        "2.nii.gz#spleen",
    ]
    assert table["file"].tolist() == ["1.nii.gz"] * 2 + ["2.nii.gz"] * 2
    assert table["part"].tolist() == ["liver", "spleen"] * 2
    assert table["class"].tolist() == ["well", "well", "ill", "ill"]
    assert table["age"].tolist() == ["40", "40", "", ""]
    assert table["unit"].tolist() == ["mm"] * 4
    n_voxels = [
        nibabel.load(root / f"{i}.nii.gz").get_fdata() == label for i in (1, 2) for label in (1, 2)
    ]
    volumes = [8 * mask.sum() for mask in n_voxels]
    assert_allclose(table["voxel_volume_mm3"], volumes)
    assert_allclose(table["volume_mm3"], volumes, rtol=1e-3)
    assert_allclose(table["spacing_z_mm"], 2)
    centres = [2 * np.argwhere(mask).mean(axis=0) for mask in n_voxels]
    places = table[["centroid_x_mm", "centroid_y_mm", "centroid_z_mm"]]
    assert_allclose(places, centres, atol=0.1)
    ball = (36 * np.pi) ** (1 / 3) * table["volume_mm3"] ** (2 / 3)
    assert_allclose(table["area_mm2"] * table["sphericity"], ball)
    extract(root, tmp_path / "features.npz")
    with np.load(tmp_path / "features.npz") as archive:
        vectors = archive["features"].reshape(4, -1)
    size = ["size.log_area", "size.log_volume"]  # as there is a unit
    columns = [*(f"v{i}" for i in range(640)), *size]
    assert table.columns.tolist()[-642:] == columns
    assert np.array_equal(table[columns].to_numpy(np.float32), vectors)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_wide_table_has_a_row_for_each_file(root, tmp_path, suffix):
    if suffix == "parquet":
        pytest.importorskip("pyarrow", reason="the extra [table]")
    read = pd.read_csv if suffix == "csv" else pd.read_parquet
    extract(root, tmp_path / f"long.{suffix}")
    extract(root, tmp_path / f"wide.{suffix}", "--wide")
    long = read(tmp_path / f"long.{suffix}")
    wide = read(tmp_path / f"wide.{suffix}")
    first = ["file", "class", "age", "unit", "liver.at_border", "liver.border_sides", "liver.notes"]
    assert wide.columns.tolist()[:7] == first
    assert len(wide.columns) == 4 + 2 * (3 + len(POWERS) + 642)
    assert wide["class"].tolist() == ["well", "ill"]
    assert wide["age"].sum() == 40  # a number in Parquet, too
    for part in ("liver", "spleen"):
        rows = long[long["part"] == part]
        for column in ("volume_mm3", "area_mm2", "v17", "v300"):
            assert wide[f"{part}.{column}"].tolist() == rows[column].tolist()


def test_a_mask_for_each_organ_makes_a_row_for_each_folder(tmp_path, capsys):
    """As TotalSegmentator writes them: two subjects with a cube and a bar, the third without the bar."""
    for i, sides in enumerate(
        [
            {"cube": (8, 8, 8), "bar": (5, 5, 15)},
            {"cube": (9, 9, 9), "bar": (5, 5, 17)},
            {"cube": (10, 10, 10)},
        ]
    ):
        (folder := tmp_path / f"masks/s{i}/segmentations").mkdir(parents=True)
        for name, (a, b, c) in sides.items():
            mask = np.zeros((20, 20, 20), dtype=np.uint8)
            mask[2 : 2 + a, 2 : 2 + b, 2 : 2 + c] = 1
            write_nifti(folder / f"{name}.nii.gz", mask)
    rows = [
        f"{path.relative_to(tmp_path / 'masks')}"
        for path in sorted((tmp_path / "masks").rglob("*.nii.gz"))
    ]
    lines = [f"{row},{row[:2]},{'b' if row.startswith('s2') else 'a'}" for row in rows]
    (tmp_path / "masks" / "labels.csv").write_text("\n".join(["file,label,folder", *lines]))
    extract(tmp_path / "masks", tmp_path / "wide.csv", "--wide")
    wide = pd.read_csv(tmp_path / "wide.csv")
    assert wide["folder"].tolist() == [f"s{i}/segmentations" for i in range(3)]
    assert_allclose(wide["cube.volume_mm3"], [512, 729, 1000], rtol=1e-3)
    assert_allclose(wide["bar.volume_mm3"], [375, 425, np.nan], rtol=1e-3)
    assert wide["folder of labels.csv"].tolist() == [
        "a",
        "a",
        "b",
    ]  # a column of the user's takes no rows together
    assert "file" not in wide
    assert wide["class"].tolist() == ["s0", "s1", "s2"]
    assert "wide.csv, rows: 3" in capsys.readouterr().out
    # Of a single subject
    extract(tmp_path / "masks/s0/segmentations", tmp_path / "one.csv", "--wide")
    one = pd.read_csv(tmp_path / "one.csv")
    assert_allclose(one[["bar.volume_mm3", "cube.volume_mm3"]], [[375, 512]], rtol=1e-3)


def test_masks_that_are_numbered_have_a_row_each(tmp_path):
    """Two subjects of each class: a number is no organ's name."""
    sides = {("ill", 0): 5, ("ill", 1): 6, ("well", 0): 7, ("well", 1): 8}
    for (label, number), side in sides.items():
        (folder := tmp_path / "masks" / label).mkdir(parents=True, exist_ok=True)
        mask = np.zeros((12, 12, 12), dtype=np.uint8)
        mask[2 : 2 + side, 2:9, 2:9] = 1
        write_nifti(folder / f"{number}.nii.gz", mask)
    extract(tmp_path / "masks", tmp_path / "wide.csv", "--wide")
    wide = pd.read_csv(tmp_path / "wide.csv")
    border = ["at_border", "border_sides"]
    assert wide.columns.tolist()[:6] == ["file", "class", "unit", *border, "notes"]
    assert wide["file"].tolist() == [f"{label}/{number}.nii.gz" for label, number in sides]
    assert_allclose(wide["volume_mm3"], [49 * side for side in sides.values()], rtol=1e-3)


@pytest.mark.parametrize("options", [[], ["--wide"]])
def test_columns_that_are_called_as_ours_are_kept_beside_them(options, root, tmp_path):
    (tmp_path / "labels.csv").write_text(
        f"file,volume_mm3,unit,v0,age\n{root / '1.nii.gz'},7,left,x,40\n{root / '2.nii.gz'},8,right,y,50\n"
    )
    extract(tmp_path, tmp_path / "features.csv", *options)
    table = pd.read_csv(tmp_path / "features.csv")
    n_rows, ours = (1, "liver.volume_mm3") if options else (2, "volume_mm3")
    assert table["volume_mm3 of labels.csv"].tolist() == [7] * n_rows + [8] * n_rows
    assert table["unit of labels.csv"].tolist() == ["left"] * n_rows + ["right"] * n_rows
    assert table["v0 of labels.csv"].tolist() == ["x"] * n_rows + ["y"] * n_rows
    assert table["age"].tolist() == [40] * n_rows + [50] * n_rows
    assert (table[ours] > 100).all()
    assert table["unit"].tolist() == ["mm"] * len(table)


def test_a_body_that_a_file_lacks_has_no_values(root, tmp_path):
    for name in ("1.nii.gz", "2.nii.gz", "1.csv", "2.csv"):
        (tmp_path / name).write_bytes((root / name).read_bytes())
    (tmp_path / "labels.csv").write_text(
        "file,body,label\n1.nii.gz,liver,a\n2.nii.gz,liver,b\n2.nii.gz,spleen,c\n"
    )
    extract(tmp_path, tmp_path / "wide.csv", "--wide")
    wide = pd.read_csv(tmp_path / "wide.csv")
    assert wide["liver.class"].tolist() == ["a", "b"]
    assert wide.loc[:, "spleen.class":].isna().all(axis=1).tolist() == [True, False]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["out.txt"], "ending in .csv, .parquet, .npz"),
        (["out.npz", "--wide"], "a table ending in .csv or .parquet"),
    ],
)
def test_a_file_of_another_kind_is_refused_before_anything_is_computed(
    root, tmp_path, capsys, options, words
):
    with pytest.raises(SystemExit, match="1"):
        extract(root, tmp_path / options[0], *options[1:])
    assert words in capsys.readouterr().err.replace("one of ", "")


def test_plain_numbers_alone_need_no_eigenpairs_and_notes_stand_in_the_row(tmp_path, monkeypatch):
    mask = np.zeros((16, 16, 16), dtype=np.uint8)
    mask[2:11, 2:11, 2:11] = 1
    mask[14, 14, 14] = 1
    write_nifti(tmp_path / "cube.nii.gz", mask)
    words = ["extract", tmp_path, "--out", tmp_path / "plain.csv", "--descriptor", "measures"]
    cache = ["--cache_dir", tmp_path / "cache", "--n_workers", 1]
    monkeypatch.setattr("igps.spectra.eigenpairs", None)  # plain numbers need none
    run(*words, *cache)
    table = pd.read_csv(tmp_path / "plain.csv", keep_default_na=False)
    own = ["file", "part", "name", "class", "unit", "at_border", "border_sides", "notes"]
    assert table.columns.tolist()[:8] == own
    assert len(table.columns) == 8 + len(POWERS)
    assert table["voxel_volume_mm3"].tolist() == [730]
    assert table["n_pieces"].tolist() == [2]
    assert table["euler_number"].tolist() == [2]
    assert "left out 1 small piece" in table["notes"][0]
