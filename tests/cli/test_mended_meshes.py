"""What commands say and write of the meshes that they mended, and of those of which nothing could be made."""

import csv
import logging

import numpy as np
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
from igps.cli.commands import COMMANDS, load_command
from own_descriptors import SMALL

ONE = ["--descriptor", "own_descriptors:small_interior", *SMALL]


@pytest.fixture
def root(tmp_path):
    """Three balls, two of them damaged, and three eggs, one of them damaged; and two boxes."""
    folder = tmp_path / "meshes"
    for label, height in (("ball", 1.0), ("egg", 2.0)):
        write_clean(folder / label / "clean.off", 1.1, height)
        write_soup(folder / label / "soup.off", 1.2, height)
    write_holed(folder / "ball" / "holed.off", 1.05, 1.0)
    write_clean(folder / "egg" / "whole.off", 1.05, 2.0)
    write_box(folder / "box" / "1.off")
    write_box(folder / "box" / "2.off").write_text((folder / "box" / "1.off").read_text() + "\n")
    return folder


WELDED = f"welded {3 * N_FACES - N_VERTICES} coincident vertices"
SUMMARY = "5 of 8 bodies repaired: 2 welded, 2 subdivided, 1 filled"


def notes(path):
    return [(row["name"], row["note"]) for row in csv.DictReader(path.open(newline=""))]


def check_notes(path):
    """Each mended file, by what was done to it by hand, and no other."""
    found = dict(notes(path))
    assert len(found) == len(notes(path))
    assert set(found) == {
        "ball/soup.off",
        "egg/soup.off",
        "ball/holed.off",
        "box/1.off",
        "box/2.off",
    }
    assert found["ball/soup.off"] == found["egg/soup.off"] == WELDED
    assert found["ball/holed.off"] == "filled 1 small hole"
    for i in (1, 2):
        assert found[f"box/{i}.off"].startswith("subdivided from 8 to ")


def test_retrieve_says_what_was_mended_from_the_cache_too(root, tmp_path, capsys):
    out = tmp_path / "out"
    for _ in range(2):
        run("retrieve", root, "--out", out, "--cache_dir", tmp_path / "cache", *ONE)
        assert capsys.readouterr().out.splitlines()[0] == SUMMARY
        check_notes(out / "notes.csv")
        (out / "notes.csv").unlink()
    # Where nothing is mended nothing is said, and the notes of an earlier run are gone.
    (out / "notes.csv").write_text("of an earlier run")
    clean = tmp_path / "clean"
    for label, height in (("ball", 1.0), ("egg", 2.0)):
        for i in range(2):
            write_clean(clean / label / f"{i}.off", 1 + 0.1 * i, height)
    run("retrieve", clean, "--out", out, "--cache_dir", tmp_path / "cache", *ONE)
    assert "repaired" not in capsys.readouterr().out
    assert not (out / "notes.csv").exists()


def test_extract_and_compare_write_the_same_notes(root, tmp_path, capsys):
    cache = ["--cache_dir", tmp_path / "cache"]
    run("extract", root, "--out", tmp_path / "deep" / "all.npz", *cache, *ONE)
    assert capsys.readouterr().out.splitlines()[0] == SUMMARY
    check_notes(tmp_path / "deep" / "all.notes.csv")
    run(
        "compare",
        root,
        "--descriptors",
        "d2",
        "--out",
        tmp_path / "out",
        *cache,
        *SMALL,
    )
    assert SUMMARY in capsys.readouterr().out.splitlines()
    check_notes(tmp_path / "out" / "notes.csv")


def test_never_and_always(root, tmp_path, capsys):
    logging.disable(logging.WARNING)
    out = ["--out", tmp_path / "out", "--cache_dir", tmp_path / "cache"]
    try:
        run("retrieve", root, "--mend", "never", *out, *ONE)
        printed = capsys.readouterr().out
        assert "5 of 8 bodies could not be used." in printed
        assert "repaired" not in printed
        refused = {
            row["name"]: row["error"]
            for row in csv.DictReader((tmp_path / "out" / "failures.csv").open())
        }
        for error in refused.values():
            assert f"\n  {error}\n" in printed
        assert set(refused) == {
            "ball/soup.off",
            "egg/soup.off",
            "ball/holed.off",
            "box/1.off",
            "box/2.off",
        }
        assert "6 boundary edges" in refused["ball/holed.off"]
        assert "expected at least 22 vertices for 20 eigenpairs" in refused["box/1.off"]
        for error in refused.values():
            assert error.startswith(str(root))
    finally:
        logging.disable(logging.NOTSET)
    run("retrieve", root, "--mend", "always", *out, *ONE)
    # What bounds a body without crossing itself is watertight.
    summary = "5 of 8 bodies repaired: 2 welded, 2 subdivided, 1 made watertight"
    assert capsys.readouterr().out.splitlines()[0] == summary
    made = {name for name, note in notes(tmp_path / "out" / "notes.csv") if "watertight" in note}
    assert made == {"ball/holed.off"}


def test_an_unknown_way_to_mend_is_refused_by_the_command(root, capsys):
    with pytest.raises(SystemExit):
        run("retrieve", root, "--mend", "perhaps", *ONE)
    error = capsys.readouterr().err
    assert "mend" in error
    for word in ("auto", "never", "always"):
        assert word in error


READS = [name for name in COMMANDS if "mend" in load_command(name).shared_options()]


@pytest.mark.parametrize("command", READS)
def test_every_command_that_reads_meshes_has_the_choice(command, capsys):
    with pytest.raises(SystemExit, match="0"):
        run(*command.split(), "--help")
    text = capsys.readouterr().out
    assert "--mend {auto,never,always}" in text
    assert "auto: repair a surface as little as possible" in " ".join(text.split())


def test_the_commands_that_read_no_meshes():
    """The demo makes its own; a report reads those of its results, training those of its file; the others read none."""
    others = {"report", "demo", "help", "train", "gallery remove", "gallery info"}
    assert set(COMMANDS) - set(READS) == others


@pytest.mark.parametrize("command", ["retrieve", "extract"])
def test_what_cannot_be_used_is_named_and_costs_the_others_nothing(
    command, tmp_path, monkeypatch, capsys, caplog
):
    without_cascadio(monkeypatch)
    root = tmp_path / "meshes"
    out = tmp_path / "out"
    for label, height in (("ball", 1.0), ("egg", 2.0)):
        for i in range(2):
            write_clean(root / label / f"{i}.off", 1 + 0.1 * i, height)

    def features(place):
        target = place if command == "retrieve" else place / "all.npz"
        run(command, root, "--out", target, "--cache_dir", place / "cache", *ONE)
        with np.load(place / ("distances.npz" if command == "retrieve" else "all.npz")) as archive:
            return archive["names"].tolist(), archive[
                "distances" if command == "retrieve" else "features"
            ]

    names, values = features(tmp_path / "clean")
    sentences = write_unusable(root / "egg")
    capsys.readouterr()
    with caplog.at_level(logging.WARNING):
        names_beside, values_beside = features(out)
    assert names_beside == names == ["ball/0.off", "ball/1.off", "egg/0.off", "egg/1.off"]
    np.testing.assert_array_equal(values_beside, values)
    said = {record.getMessage() for record in caplog.records if "skipped" in record.getMessage()}
    assert said == {
        f"skipped: {root / 'egg' / name}: {sentence}" for name, sentence in sentences.items()
    }
    printed = capsys.readouterr()
    assert "Traceback" not in printed.out + printed.err
    if command == "retrieve":
        rows = {
            row["name"]: row["error"]
            for row in csv.DictReader((out / "failures.csv").open(newline=""))
        }
        assert rows == {
            f"egg/{name}": f"{root / 'egg' / name}: {sentence}"
            for name, sentence in sentences.items()
        }
    assert f"{len(sentences)} of {4 + len(sentences)} bodies could not be used." in printed.out
