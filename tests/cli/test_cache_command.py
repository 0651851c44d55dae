"""`igps cache export`: one file in place of the folder, for every command, without the meshes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from commands import run
from igps.data.dataset import SignatureDataset
from igps.descriptors import descriptor
from own_descriptors import SMALL, write_egg

INTERIOR = "own_descriptors:small_interior"


@pytest.mark.parametrize("labelled", [True, False])
def test_the_file_stands_for_the_folder(
    labelled: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for label, height in (("flat", 0.5), ("long", 2.0)):
        for i in range(2):
            name = f"eggs/{label}/{i}.off" if labelled else f"eggs/{label}{i}.off"
            write_egg(tmp_path / name, height * (1 + 0.05 * i), subdivisions=2)
    (tmp_path / "eggs" / "bad.off").write_text("nothing") if not labelled else None
    cache = ["--cache_dir", tmp_path / "cache"]
    out = tmp_path / "signatures.igps"
    command = ["retrieve", "--json"] if labelled else ["query", tmp_path / "egg.off", "--json"]
    where = [] if labelled else ["--gallery"]
    write_egg(tmp_path / "egg.off", 2.0, subdivisions=2)
    run(monkeypatch, *command, *where, tmp_path / "eggs", "--descriptor", INTERIOR, *cache, *SMALL)
    expected = json.loads(capsys.readouterr().out)
    run(
        monkeypatch,
        "precompute",
        tmp_path / "eggs",
        "--out",
        out,
        "--descriptors",
        INTERIOR,
        *cache,
        *SMALL,
    )
    told = capsys.readouterr().out
    assert f"4 signatures written to {out}\n" in told
    assert ("1 of 5 bodies could not be used. The first: " in told) == (not labelled)
    shutil.rmtree(tmp_path / "eggs")
    shutil.rmtree(tmp_path / "cache")
    if labelled:
        run(monkeypatch, *command, out, "--descriptor", INTERIOR, *cache)
        assert json.loads(capsys.readouterr().out) == expected
        for option in (["--mend", "never"], ["--attribute", "ct={file}.nii"]):
            with pytest.raises(SystemExit, match="1"):
                run(monkeypatch, *command, out, "--descriptor", INTERIOR, *cache, *option)
            assert (
                "expected no reading options with a file of signatures" in capsys.readouterr().err
            )
        run(
            monkeypatch,
            "extract",
            out,
            "--out",
            tmp_path / "rows.npz",
            "--descriptor",
            INTERIOR,
            *cache,
        )
        names = np.load(tmp_path / "rows.npz")["names"].tolist()
        assert names == ["flat/0.off", "flat/1.off", "long/0.off", "long/1.off"]
        with pytest.raises(SystemExit, match="1"):
            run(monkeypatch, "explain", out, "--level", 0.5, "--descriptor", INTERIOR, *cache)
        assert "expected meshes, got a file of signatures" in capsys.readouterr().err
    else:
        with pytest.raises(SystemExit, match="1"):
            run(monkeypatch, "retrieve", out, "--descriptor", INTERIOR, *cache)
        assert "expected signatures with classes" in capsys.readouterr().err


def test_lists_of_files_may_be_one_file_of_signatures_and_what_needs_meshes_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for label, height in (("flat", 0.5), ("long", 2.0)):
        for i in range(2):
            write_egg(
                tmp_path / "eggs" / label / f"{i}.off", height * (1 + 0.05 * i), subdivisions=2
            )
    cache = ["--cache_dir", tmp_path / "cache"]
    out = tmp_path / "signatures.igps"
    rich = ["--descriptor", "rich"]
    model = tmp_path / "mine.safetensors"
    small = SMALL[2:]
    run(
        monkeypatch,
        "precompute",
        tmp_path / "eggs",
        "--out",
        out,
        "--descriptors",
        "rich",
        *cache,
        *small,
    )
    run(
        monkeypatch,
        "extract",
        tmp_path / "eggs",
        *rich,
        "--out",
        tmp_path / "folder.csv",
        *cache,
        *small,
    )
    run(monkeypatch, "fit", out, *rich, "--head", "classifier", "--out", model, *cache)
    capsys.readouterr()
    run(monkeypatch, "classify", tmp_path / "eggs", "--model", model, *cache, *small, "--json")
    expected = json.loads(capsys.readouterr().out)
    shutil.rmtree(tmp_path / "eggs")
    run(monkeypatch, "extract", out, *rich, "--out", tmp_path / "file.csv", *cache)
    assert (tmp_path / "file.csv").read_text() == (tmp_path / "folder.csv").read_text()
    capsys.readouterr()
    run(monkeypatch, "classify", out, "--model", model, *cache, "--json")
    assert json.loads(capsys.readouterr().out) == expected
    for command, message in (
        (["outliers", out, *rich, *cache], "expected meshes, got a file of signatures"),
        (["explain", out, *rich, *cache], "expected meshes, got a file of signatures"),
        (["duplicates", out, *cache], "expected meshes, got a file of signatures"),
        (["doctor", out], "expected a folder, got a file"),
    ):
        with pytest.raises(SystemExit, match="1"):
            run(monkeypatch, *command)
        assert message in capsys.readouterr().err


def test_what_joins_a_descriptor_joins_the_one_that_is_computed_for_where_none_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_egg(tmp_path / "eggs" / "0.off", 2.0, subdivisions=2)
    run(
        monkeypatch,
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


def test_a_mesh_in_place_of_a_folder_is_told_as_such(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was taken for a damaged file of signatures, with the advice to export it again."""
    write_egg(tmp_path / "egg.off", 2.0, subdivisions=2)
    for command in (
        ["retrieve", tmp_path / "egg.off"],
        ["query", tmp_path / "egg.off", "--gallery", tmp_path / "egg.off"],
    ):
        with pytest.raises(SystemExit, match="1"):
            run(monkeypatch, *command, "--cache_dir", tmp_path / "cache")
        assert (
            capsys.readouterr().err
            == f"igps: {tmp_path / 'egg.off'}: expected a folder, got a file.\n"
        )
