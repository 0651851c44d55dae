"""`igps precompute`: what it computes; and files in place of folders."""

import pytest

from commands import run
from igps.data.dataset import SignatureDataset
from igps.descriptors import descriptor
from own_descriptors import write_egg

INTERIOR = "own_descriptors:small_interior"


def test_what_joins_a_descriptor_joins_the_one_that_is_computed_for_where_none_is_named(tmp_path):
    write_egg(tmp_path / "eggs" / "0.off", 2.0, subdivisions=2)
    run(
        "precompute",
        tmp_path / "eggs",
        "--with",
        "potential",
        "--cache_dir",
        tmp_path,
        "--n_workers",
        1,
    )
    dataset = SignatureDataset(
        tmp_path / "eggs", cache_dir=tmp_path, descriptor=descriptor("pretrained+potential")
    )
    assert None not in dataset.cached_keys()


def test_a_mesh_in_place_of_a_folder_is_told_as_such(tmp_path, capsys):
    write_egg(tmp_path / "egg.off", 2.0, subdivisions=2)
    for command in (
        ["retrieve", tmp_path / "egg.off"],
        ["query", tmp_path / "egg.off", "--gallery", tmp_path / "egg.off"],
    ):
        with pytest.raises(SystemExit, match="1"):
            run(*command, "--cache_dir", tmp_path / "cache")
        assert (
            capsys.readouterr().err
            == f"igps: {tmp_path / 'egg.off'}: expected a folder, got a file. Check the path.\n"
        )
