"""`igps doctor`: its table, its file, and its exit status."""

import csv

import pytest

from commands import run
from damaged_files import (
    N_FACES,
    N_VERTICES,
    without_cascadio,
    write_box,
    write_clean,
    write_holed,
    write_soup,
    write_unusable,
)

FEW = ["--signature.n_eigenpairs", "20", "--n_workers", "1"]


def test_table_and_file_of_a_folder_that_can_be_used(tmp_path, capsys):
    root = tmp_path / "meshes"
    out = tmp_path / "deep" / "doctor.csv"
    write_clean(root / "a" / "clean.off")
    write_soup(root / "a" / "soup.off")
    write_box(root / "b" / "box.off")
    run("doctor", root, "--out", out, *FEW)  # no status: nothing is raised
    header, *lines, total, written = capsys.readouterr().out.splitlines()
    assert header.split() == ["vertices", "after", "seconds", "MB", "unit", "remarks"]
    cells = {line.split()[0]: line.split()[1:] for line in lines}
    size = str(N_VERTICES)
    assert cells["a/clean.off"][:2] + cells["a/clean.off"][4:] == [size, size, "none", "none"]
    soup = cells["a/soup.off"]
    assert soup[:2] + soup[4:] == [str(3 * N_FACES), size, "none", "welded"]
    assert cells["b/box.off"][0] == "8"
    assert cells["b/box.off"][4:] == ["none", "subdivided"]
    assert total.startswith("3 bodies: 2 repaired, 0 cannot be used; about ")
    assert written == f"written to {out}"

    rows = {row["name"]: row for row in csv.DictReader(out.open(newline=""))}
    assert list(rows) == ["a/clean.off", "a/soup.off", "b/box.off"]
    for name, row in rows.items():
        numbers = [row["vertices"], row["vertices_after"], row["seconds"], row["megabytes"]]
        assert numbers == cells[name][:4]
        assert row["usable"] == "yes"
        assert row["error"] == ""
        assert float(row["seconds"]) > 0
        assert float(row["megabytes"]) > 0
    for column in ("fault", "mended_by", "notes"):
        assert rows["a/clean.off"][column] == ""
    assert "boundary edges" in rows["a/soup.off"]["fault"]
    assert rows["a/soup.off"]["mended_by"] == "welded"
    assert rows["a/soup.off"]["notes"] == f"welded {3 * N_FACES - N_VERTICES} coincident vertices"


def test_status_is_1_if_a_file_cannot_be_used(tmp_path, monkeypatch, capsys):
    without_cascadio(monkeypatch)
    root = tmp_path / "meshes"
    out = tmp_path / "doctor.csv"
    write_clean(root / "clean.off")
    sentences = write_unusable(root)
    with pytest.raises(SystemExit) as stopped:
        run("doctor", root, "--out", out, *FEW)
    assert stopped.value.code == 1
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    for name, sentence in sentences.items():
        (line,) = [line for line in lines if line.startswith(f"{name} ")]
        assert line.endswith(f"cannot be used: {root / name}: {sentence}")
    total = f"{1 + len(sentences)} bodies: 0 repaired, {len(sentences)} cannot be used"
    assert any(line.startswith(total) for line in lines)
    assert "Traceback" not in printed.out + printed.err
    rows = {row["name"]: row for row in csv.DictReader(out.open(newline=""))}
    usable = [name for name, row in rows.items() if row["usable"] == "yes"]
    assert usable == ["clean.off"]
    assert set(rows) == {"clean.off", *sentences}
    for name, sentence in sentences.items():
        assert rows[name]["error"] == f"{root / name}: {sentence}"


def test_options_choose_the_mending(tmp_path, capsys):
    write_holed(tmp_path / "holed.off")
    with pytest.raises(SystemExit, match="1"):
        run("doctor", tmp_path, "--mend", "never", *FEW)
    assert "cannot be used" in capsys.readouterr().out
    run("doctor", tmp_path, "--mend", "always", *FEW)
    assert "; watertight; closed 1 opening" in capsys.readouterr().out.splitlines()[1]


def test_a_folder_without_meshes_is_an_error(tmp_path, capsys):
    with pytest.raises(SystemExit, match="1"):
        run("doctor", tmp_path, *FEW)
    assert f"igps: {tmp_path}: no body found" in capsys.readouterr().err


def test_files_that_bodies_bring_along_are_not_examined(tmp_path, capsys):
    write_clean(tmp_path / "a" / "clean.off")
    write_clean(tmp_path / "a" / "clean_fields.off")
    run("doctor", tmp_path, "--attribute", "f=a/{stem}_fields.off", *FEW)
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("1 body: 0 repaired, 0 cannot be used")
