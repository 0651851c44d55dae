"""Tables of names that the package brings, and that names of labels compute nothing anew."""

import numpy as np
import pytest

from igps import SignatureConfig, SignatureDataset
from igps.data import pipeline
from igps.fields.volumes.label_names import BUILT_IN, read_label_names
from igps.fields.volumes.label_volume import read_label_volume
from igps.mesh.errors import MeshError
from igps.mesh.options import LoadOptions
from label_files import write_nifti

SMALL = SignatureConfig(n_eigenpairs=10, min_samples=50, n_surface_samples=50)


def write(path, numbers):
    """Boxes in a row, each 8 voxels high, one smaller than the next."""
    labels = np.zeros(
        (8 * len(numbers) + 4, 12, 12),
        dtype=np.uint8,
    )
    if max(numbers) > 255:
        labels = labels.astype(np.uint16)
    for i, number in enumerate(numbers):
        labels[8 * i + 2 : 8 * i + 9 - i, 2:10, 2:10] = number
    write_nifti(path, labels)


def names_in(path, names):
    volume = read_label_volume(path, LoadOptions(names=names))
    return [body.name for body in volume.bodies]


def test_the_numbers_of_well_known_structures():
    """As FastSurfer's FastSurfer_ColorLUT.tsv and TotalSegmentator's page of classes have them."""
    tables = {name: read_label_names(path) for name, path in BUILT_IN.items()}
    brain = tables["freesurfer"]
    assert [brain[i] for i in (2, 10, 17, 53, 49, 63)] == [
        "Left-Cerebral-White-Matter",
        "Left-Thalamus",
        "Left-Hippocampus",
        "Right-Hippocampus",
        "Right-Thalamus",
        "Right-choroid-plexus",
    ]
    assert [brain[i] for i in (1002, 1035, 2028)] == [
        "ctx-lh-caudalanteriorcingulate",
        "ctx-lh-insula",
        "ctx-rh-superiorfrontal",
    ]
    body = tables["totalsegmentator"]
    assert sorted(body) == list(range(1, 118))
    assert [body[i] for i in (1, 5, 52, 90, 117)] == [
        "spleen",
        "liver",
        "aorta",
        "brain",
        "costal_cartilages",
    ]
    first = tables["totalsegmentator_v1"]
    assert sorted(first) == list(range(1, 105))
    assert [first[i] for i in (5, 7, 50, 104)] == ["liver", "aorta", "brain", "urinary_bladder"]
    for names in tables.values():
        assert len(set(names.values())) == len(names)
        for word, other in (("Left-", "Right-"), ("_left", "_right"), ("-lh-", "-rh-")):
            paired = {name for name in names.values() if word in name}
            missing = {name.replace(word, other) for name in paired} - set(names.values())
            # The published table of FreeSurfer calls label 65 Right-lOg; the left atrium alone has the appendage
            assert missing <= {"Right-aOg", "atrial_appendage_right"}


def test_built_in_names_are_for_volumes_without_names(tmp_path):
    write(tmp_path / "aseg.nii.gz", [17, 53])
    assert names_in(tmp_path / "aseg.nii.gz", "freesurfer") == [
        "Left-Hippocampus",
        "Right-Hippocampus",
    ]
    assert names_in(tmp_path / "aseg.nii.gz", None) == ["17", "53"]
    (tmp_path / "aseg.csv").write_text("label,name\n17,mine\n53,yours\n")
    assert names_in(tmp_path / "aseg.nii.gz", "freesurfer") == ["mine", "yours"]
    write(tmp_path / "liver.nii.gz", [1])  # a mask, and no spleen
    assert names_in(tmp_path / "liver.nii.gz", "totalsegmentator") == ["liver"]
    with pytest.raises(MeshError, match="or give freesurfer, totalsegmentator, totalseg"):
        names_in(tmp_path / "aseg.nii.gz", "freesurfr")


def test_other_names_compute_nothing_anew_and_name_the_right_bodies(tmp_path, monkeypatch):
    (folder := tmp_path / "subjects").mkdir()
    write(folder / "s1.nii.gz", [3, 5])
    cache = tmp_path / "cache"
    first = SignatureDataset(folder, SMALL, cache)
    volumes = [item.signature.volume for item in first]
    assert first.bodies.parts == ("3", "5")

    def fail(*_):
        raise AssertionError("a signature was computed anew")

    monkeypatch.setattr(pipeline, "compute_signature", fail)
    table = tmp_path / "names.csv"
    for rows in ("3,liver\n5,spleen\n", "3,spleen\n5,liver\n"):
        table.write_text(f"label,name\n{rows}")
        reading = LoadOptions(names=str(table))
        named = SignatureDataset(folder, SMALL, cache, reading=reading)
        words = [line.partition(",")[2] for line in rows.split()]
        assert list(named.bodies.parts) == words
        assert [item.signature.volume for item in named] == volumes
        one = SignatureDataset([f"{folder / 's1.nii.gz'}#liver"], SMALL, cache, reading=reading)
        assert one[0].signature.volume == volumes[words.index("liver")]
    reading = LoadOptions(names="totalsegmentator")
    built_in = SignatureDataset(folder, SMALL, cache, reading=reading)
    assert list(built_in.bodies.parts) == ["kidney_left", "liver"]
    assert [item.signature.volume for item in built_in] == volumes
