"""Bodies that the border of an image cuts are told, with the sides of the patient; whole ones are not."""

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from commands import error_of, run
from igps.fields.volumes.border import border_of
from igps.fields.volumes.label_volume import LabelVolume, label_surface
from label_files import write_nifti

N = 32
RADIUS = 9.0


def ball(centre):
    index = np.indices((N, N, N)).reshape(3, -1).T
    return (np.linalg.norm(index - np.array(centre), axis=1) < RADIUS).reshape(N, N, N)


def cut_share(depth):
    """Of a ball cut by a plane at this distance from its centre: the disc over the surface of what is left."""
    disc = np.pi * (RADIUS**2 - depth**2)
    cap = 2 * np.pi * RADIUS * (RADIUS - depth)
    return float(disc / (4 * np.pi * RADIUS**2 - cap + disc))


LETTERS = ("RL", "AP", "IS")  # at the first and the last slice of each axis of the image below
FRAMELESS = {"R": "+x", "L": "-x", "A": "+y", "P": "-y", "I": "-z", "S": "+z"}


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("end", [0, 1])
def test_each_side_of_an_oblique_image_is_told_with_its_share(axis, end):
    """The axes of the image run to the left, to the back and up (LPS), turned by 20° about each axis."""
    depth = (1.0, 4.0, 7.0)[axis]
    at = [N / 2] * 3
    at[axis] = N - 0.5 - depth if end else depth - 0.5
    affine = np.eye(4)
    turned = Rotation.from_euler("xyz", [20, 20, 20], degrees=True).as_matrix()
    affine[:3, :3] = turned @ np.diag([-1.5, -1.5, 1.5])
    labels = (ball((at[0], at[1], at[2])).astype(np.uint8),)
    letter = LETTERS[axis][end]
    border = border_of(label_surface(LabelVolume(labels, affine, frame="RAS"), 1).notes)
    assert border is not None
    assert border.sides == letter
    # The last slice of voxels is half a voxel before the plane, where the ball is a little wider
    assert border.share == pytest.approx(cut_share(depth), abs=0.03)
    border = border_of(label_surface(LabelVolume(labels, affine), 1).notes)
    assert border is not None
    assert border.sides == FRAMELESS[letter]


def test_no_whole_body_is_told_and_every_cut_one(tmp_path, capsys):
    """Whole balls one voxel from the border, and balls that a corner or a face cuts by a voxel or more."""
    inner = RADIUS + 0.5
    whole = {f"whole{i}": (inner, N - 1 - inner, 16.0 + i) for i in range(3)}
    cut = {
        "corner": (5.0, 5.0, 5.0),
        "face": (RADIUS - 1.5, 16.0, 16.0),
        "half": (16.0, 16.0, N),
    }
    for name, centre in {**whole, **cut}.items():
        write_nifti(tmp_path / f"{name}.nii.gz", ball(centre).astype(np.uint8))
    out = tmp_path / "table.csv"
    words = ["--descriptor", "measures", "--cache_dir", tmp_path / "cache", "--n_workers", 1]
    run("extract", tmp_path, "--out", out, *words)
    table = pd.read_csv(out, keep_default_na=False).set_index("part")
    assert dict(table["border_sides"]) == {
        "corner": "LPI",
        "face": "L",
        "half": "S",
        **dict.fromkeys(whole, ""),
    }
    assert (table["at_border"] > 0).tolist() == [name in cut for name in table.index]
    capsys.readouterr()
    run("extract", tmp_path, "--out", out, "--complete", *words)
    assert "3 of 6 bodies at the border of the image, left out" in capsys.readouterr().out
    assert set(pd.read_csv(out)["part"]) == set(whole)
    run("doctor", tmp_path, "--out", out, "--n_workers", 1)
    found = pd.read_csv(out, keep_default_na=False).set_index("name")
    assert found.loc["corner.nii.gz#corner", "border_sides"] == "LPI"
    assert found.loc["whole0.nii.gz#whole0", "at_border"] == ""
    for name in whole:
        (tmp_path / f"{name}.nii.gz").unlink()
    line = error_of(capsys, "extract", tmp_path, "--out", out, "--complete", *words)
    assert "all of 3 bodies reach the border of their image" in line
