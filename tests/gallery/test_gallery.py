"""A gallery of meshes against the comparison with each of them."""

import contextlib
import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from bodies_on_disk import write_body
from commands import error_of, run
from igps.data.dataset import SignatureDataset
from igps.data.sources import find_bodies
from igps.gallery import rows
from igps.gallery.about import check_alike
from igps.gallery.gallery import Gallery
from igps.gallery.sync import sync
from igps.mesh.options import LoadOptions
from igps.nn.description import describe
from igps.retrieval import chi_square
from igps.signature.signature import SignatureConfig
from label_files import write_nifti
from own_descriptors import CONFIG, SMALL, small_interior

INTERIOR = "own_descriptors:small_interior"


@pytest.fixture
def root(tmp_path):
    for label, ratio in (("ball", 1.0), ("egg", 2.2)):
        for i in range(3):
            write_body(tmp_path / "meshes" / label / f"{i}.off", 1.0 + 0.06 * i, ratio)
    return tmp_path / "meshes"


@pytest.fixture
def dataset(root, tmp_path):
    return SignatureDataset(root, CONFIG, tmp_path / "cache")


def block_and_bar():
    labels = np.zeros((24, 16, 16), np.uint8)
    labels[2:8, 3:12, 3:12] = 1
    labels[11:22, 5:9, 5:9] = 2
    return labels


def names_in(gallery):
    return sorted(row["name"] for row in gallery.rows("name"))


def test_it_ranks_as_the_descriptor_does(dataset, root, tmp_path):
    gallery, failures = Gallery.build(
        tmp_path / "g.igps",
        dataset,
        small_interior(),
        n_workers=1,
    )
    assert failures == []
    histograms = describe(dataset, small_interior())
    distances = chi_square(histograms[4:5], histograms)[0]
    found = gallery.query(root / "egg" / "1.off", top=4, cache_dir=tmp_path / "cache")
    nearest = torch.argsort(distances, stable=True)[:4].tolist()
    assert [match.name for match in found] == [dataset.bodies.names[i] for i in nearest]
    assert [match.label for match in found] == [(dataset.bodies.labels or ())[i] for i in nearest]
    assert [match.path for match in found] == [dataset.bodies.paths[i].resolve() for i in nearest]
    np.testing.assert_allclose(
        [match.distance for match in found], distances[nearest], rtol=2e-3, atol=1e-6
    )


def test_adding_is_building(dataset, root, tmp_path):
    whole, _ = Gallery.build(tmp_path / "whole.igps", dataset, INTERIOR, n_workers=1)
    added, _ = Gallery.build(
        tmp_path / "a.igps",
        dataset.subset([0, 1, 2]),
        INTERIOR,
        n_workers=1,
    )
    added.add(
        dataset.subset([2, 3, 4]),
        n_workers=1,
    )
    assert len(added) == 5
    added.add(dataset.subset([5]), n_workers=1)
    described = describe(dataset, small_interior())
    assert added.nearest(described) == whole.nearest(described)
    # A file of other content takes the place of what it was.
    write_body(root / "ball" / "1.off", 3.0, 0.3)
    added.add(dataset, n_workers=1)
    assert len(added) == 6
    (first, *_) = added.query(root / "ball" / "1.off", cache_dir=tmp_path / "cache")
    assert first.name == "ball/1.off"
    assert first.distance < 1e-6


def test_a_gallery_is_merged_into_another_by_its_rows(dataset, tmp_path):
    """As the page about galleries shows."""
    whole, _ = Gallery.build(tmp_path / "whole.igps", dataset, INTERIOR, n_workers=1)
    one, _ = Gallery.build(
        tmp_path / "a.igps",
        dataset.subset([0, 1, 2]),
        INTERIOR,
        n_workers=1,
    )
    rest = dataset.subset([2, 3, 4, 5])
    other, _ = Gallery.build(tmp_path / "b.igps", rest, INTERIOR, n_workers=1)
    check_alike(one.path, one.about, other.about)
    for batch in other.table.batches():
        one.table.add(*other.table.decoded(batch), {})
    described = describe(dataset, small_interior())
    assert one.nearest(described) == whole.nearest(described)


def test_bodies_of_one_file_are_entries_of_their_own(tmp_path):
    boxes = [trimesh.creation.box(extents=(1, 1, length)) for length in (1.0, 2.0, 4.0)]
    for i, one in enumerate(boxes):
        one.apply_translation((3 * i, 0, 0))
    trimesh.Scene({f"part {i}": one for i, one in enumerate(boxes)}).export(tmp_path / "plate.glb")
    reading = LoadOptions(bodies="objects")
    bodies = find_bodies(tmp_path, reading)
    dataset = SignatureDataset(bodies, CONFIG, tmp_path / "cache", reading=reading)
    gallery, _ = Gallery.build(tmp_path / "plate.igps", dataset, INTERIOR, n_workers=1)
    gallery.add(dataset, n_workers=1)
    file = (tmp_path / "plate.glb").resolve()
    told = {(row["file"], row["part"]) for row in gallery.rows("file", "part")}
    assert told == {(str(file), part) for part in bodies.parts}
    found = gallery.nearest(describe(dataset, small_interior()), top=1)
    assert [one.name for (one,) in found] == list(bodies.names)
    assert {one.path for (one,) in found} == {file}


def test_what_cannot_be_described_is_told(root, tmp_path):
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    picky = "own_descriptors:picky"
    gallery, failures = Gallery.build(tmp_path / "g.igps", dataset, picky, n_workers=1)
    assert [failure.id for failure in failures] == ["egg/1.off"]
    assert len(gallery) == 5
    failures = gallery.add(dataset, n_workers=1)
    assert [failure.id for failure in failures] == ["egg/1.off"]
    assert "too much" in failures[0].error
    assert len(gallery) == 5
    alone = dataset[["egg/1.off"]]
    words = r"none of 1 bodies could be described; the first: .*1\.off: .*too much"
    with pytest.raises(ValueError, match=words):
        Gallery.build(tmp_path / "none.igps", alone, picky, n_workers=1)


def test_a_query_of_a_gallery_is_that_of_its_folder(root, tmp_path, capsys):
    index = tmp_path / "gallery.igps"
    cache = ["--cache_dir", tmp_path / "cache"]
    by_name = ["--descriptor", INTERIOR, *cache, *SMALL]

    def lines(*arguments):
        run(*arguments)
        return capsys.readouterr().out.splitlines()

    built = lines("gallery", "build", root, "--out", index, *by_name)
    assert built[-1] == f"{index}: 6 bodies by {INTERIOR}"
    query = ["query", root / "egg" / "1.off"]
    expected = lines(*query, "--gallery", root, "--top", 4, *by_name)
    assert lines(*query, "--gallery", index, "--top", 4, *cache) == expected
    reranked = lines(*query, "--gallery", root, "--rerank", *by_name)
    assert len(reranked) == 7
    assert reranked[:5] != expected[:5]
    assert lines(*query, "--gallery", index, "--rerank", *cache) == reranked
    (root / "egg" / "0.off").unlink()
    *same, warning = lines(*query, "--gallery", index, "--top", 4, *cache)
    assert same == expected
    assert warning == "1 of these 4 files were moved or deleted since they were described."


def test_what_does_not_fit_is_refused_in_a_sentence(dataset, root, tmp_path, monkeypatch, capsys):
    index = tmp_path / "g.igps"
    mesh = root / "egg" / "1.off"
    Gallery.build(index, dataset, INTERIOR, n_workers=1)
    query = ["query", mesh, "--gallery", index, "--cache_dir", tmp_path / "cache"]
    other = f'expected a gallery with descriptor "rich", got "{INTERIOR}". Use the parameters of'
    columns = "where: expected a condition on the columns id, name, class, file, part"
    for options, words in (
        (["--descriptor", "rich"], other),
        (["--signature.resolution", 12], "expected a gallery with signature."),
        (["--mend", "never"], 'expected a gallery with reading.mend "never", got "auto"'),
        (["--where", "weight > 3"], columns),
    ):
        assert words in error_of(capsys, *query, *options)
    query_in = ["query", mesh, "--gallery"]
    assert "no such folder" in error_of(capsys, *query_in, tmp_path / "none.igps")
    of_meshes = error_of(capsys, *query_in, root, "--where", "volume > 3")
    assert "where: expected a gallery" in of_meshes
    gone = error_of(capsys, "gallery", "sync", tmp_path / "gone", "--gallery", index)
    assert "gone: no such folder" in gone
    changed = small_interior()
    next(changed.buffers()).add_(1e-3)
    changed.name = INTERIOR
    with pytest.raises(ValueError, match=r"expected a gallery with model .*, got "):
        Gallery(index, changed)
    assert len(Gallery(index)) == 6
    monkeypatch.setattr(SignatureConfig, "ALGORITHM_VERSION", SignatureConfig.ALGORITHM_VERSION + 1)
    assert "version" in error_of(capsys, *query)


def test_rows_tell_size_class_and_what_labels_tell(root, tmp_path):
    """Volumes and areas are those of the meshes, and a condition keeps what NumPy keeps."""
    labelled = []
    table = "file,label,age,scanner\n"
    for name in ("ball/0", "ball/1", "ball/2", "egg/0", "egg/1", "egg/2"):
        label, number = name.split("/")
        row = (f"{name}.off", f"{label}s", 10 * int(number), "A" if int(number) else "")
        labelled.append(row)
        table += ",".join(map(str, row)) + "\n"
    (root / "labels.csv").write_text(table)
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    gallery, _ = Gallery.build(
        tmp_path / "g.igps",
        dataset,
        small_interior(),
        n_workers=1,
    )
    assert {"volume", "area", "age", "scanner"} <= gallery.columns.keys()
    meshes = {name: trimesh.load(root / name) for name, *_ in labelled}
    told = {row["name"]: row for row in gallery.rows(*gallery.columns)}
    for name, label, age, scanner in labelled:
        assert told[name]["volume"] == pytest.approx(meshes[name].volume)
        assert told[name]["area"] == pytest.approx(meshes[name].area)
        assert told[name]["class"] == label
        assert told[name]["age"] == age
        assert told[name]["scanner"] == (scanner or None)
    description = describe(dataset, small_interior())[:1]
    volume = meshes["egg/1.off"].volume * 1.001
    where = f"age >= 10 AND class = 'eggs' AND volume > {volume}"
    (found,) = gallery.nearest(description, where=where)
    assert [one.name for one in found] == ["egg/2.off"]
    assert gallery.nearest(description, where="age > 99") == [[]]


def test_sync_finds_what_is_new_changed_and_gone(root, tmp_path, monkeypatch, request):
    """Afterwards it is what building makes; what has not changed is neither described nor written."""
    cache = tmp_path / "cache"
    monkeypatch.setattr(rows, "MIN_AGE", 10**18)  # however busy the machine, no file is old

    def now(folder=root):
        return SignatureDataset(folder, CONFIG, cache)

    gallery, _ = Gallery.build(
        tmp_path / "g.igps",
        now(),
        small_interior(),
        n_workers=1,
    )
    write_body(tmp_path / "elsewhere" / "o'clock.off", 1.0, 1.5)
    gallery.add(now(tmp_path / "elsewhere"), n_workers=1)
    version = gallery.table.table.version
    found = sync(gallery, now(), root, n_workers=1)
    assert found == (0, 0, [])
    assert gallery.table.table.version == version
    request.getfixturevalue("trust_recent_files")
    sync(gallery, now(), root, n_workers=1)
    with monkeypatch.context() as context:
        context.setattr(SignatureDataset, "key", lambda *_: pytest.fail("a file was read"))
        found = sync(gallery, now(), root, n_workers=1)
        assert found == (0, 0, [])
    write_body(root / "egg" / "new.off", 1.3, 2.0)
    write_body(root / "ball" / "1.off", 3.0, 0.3)
    (root / "egg" / "0.off").unlink()
    (root / "egg" / "broken.off").write_text("OFF\n1 0 0\n0 0 0\n")
    n_new, n_gone, (failure,) = sync(gallery, now(), root, n_workers=1)
    assert n_new == 2
    assert n_gone == 1
    assert failure.id == "egg/broken.off"
    (root / "egg" / "broken.off").unlink()
    table = "file,label\n"
    for name in now().bodies.names:
        table += f"{name},round\n"
    (root / "labels.csv").write_text(table)
    dataset = now()
    assert sync(gallery, dataset, root, n_workers=1) == (0, 0, [])
    assert gallery.remove("name = 'o''clock.off'") == 1
    built, _ = Gallery.build(
        tmp_path / "built.igps",
        dataset,
        small_interior(),
        n_workers=1,
    )
    described = describe(dataset, small_interior())
    assert gallery.nearest(described) == built.nearest(described)
    assert {one.label for one in built.nearest(described)[0]} == {"round"}


def test_sync_keeps_what_lies_in_a_folder_that_may_not_be_read(root, tmp_path, monkeypatch, caplog):
    cache = tmp_path / "cache"
    dataset = SignatureDataset(root, CONFIG, cache)
    gallery, _ = Gallery.build(
        tmp_path / "g.igps",
        dataset,
        small_interior(),
        n_workers=1,
    )
    scan = os.scandir
    access = os.access

    def refused(path):
        if Path(path).name == "egg":
            raise PermissionError(13, "Permission denied", str(path))
        return scan(path)

    def may(path, how):
        return Path(path).name != "egg" and access(path, how)

    (root / "ball" / "0.off").unlink()
    monkeypatch.setattr(os, "access", may)  # whoever runs tests may read everything
    with monkeypatch.context() as context:
        context.setattr(os, "scandir", refused)
        seen = SignatureDataset(root, CONFIG, cache)
    assert "egg: this folder is left out" in caplog.text
    assert len(seen) == len(dataset) - 4
    assert sync(gallery, seen, root, n_workers=1) == (0, 1, [])
    assert names_in(gallery) == sorted({*dataset.bodies.names} - {"ball/0.off"})


def test_it_opens_where_it_was_moved_to(dataset, tmp_path):
    gallery, _ = Gallery.build(
        tmp_path / "g.igps",
        dataset,
        small_interior(),
        n_workers=1,
    )
    described = describe(dataset, small_interior())
    expected = gallery.nearest(described)
    (tmp_path / "far").mkdir()
    (tmp_path / "g.igps").rename(tmp_path / "far" / "h.igps")
    moved = Gallery(tmp_path / "far" / "h.igps", small_interior())
    assert moved.nearest(described) == expected
    assert moved.remove("class = 'egg'") == 3


def test_commands_that_change_a_gallery(root, tmp_path, capsys):
    gallery = tmp_path / "gallery.igps"
    cache = ["--cache_dir", tmp_path / "cache", "--n_workers", 1]

    def lines(*arguments):
        run(*arguments)
        return capsys.readouterr().out.splitlines()

    lines("gallery", "build", root, "--out", gallery, "--descriptor", INTERIOR, *cache, *SMALL)
    removed = lines("gallery", "remove", gallery, "--where", "name = 'egg/0.off'")
    assert removed[0] == "1 bodies removed"
    (root / "egg" / "1.off").unlink()
    synced = lines("gallery", "sync", root, "--gallery", gallery, *cache)
    assert synced[-2:] == ["1 body described, 1 removed", f"{gallery}: 5 bodies by {INTERIOR}"]
    info = json.loads("\n".join(lines("gallery", "info", gallery, "--json")))
    assert info["bodies"] == 5
    assert info["descriptor"] == INTERIOR
    assert info["columns"]["volume"] == "float"
    query = ["query", root / "egg" / "2.off", "--gallery", gallery, "--where", "class = 'ball'"]
    assert len(lines(*query, "--exact", *cache)) == 1 + 3


def test_sync_notices_a_table_of_names_that_was_edited(tmp_path, trust_recent_files):
    """With its two names swapped the rows have the same names, and the bodies of each other."""
    write_nifti(tmp_path / "scans" / "scan.nii.gz", block_and_bar())
    table = tmp_path / "names.json"
    table.write_text('{"1": "block", "2": "bar"}')

    def now():
        reading = LoadOptions(bodies="labels", names=str(table))
        return SignatureDataset(tmp_path / "scans", CONFIG, tmp_path / "cache", reading=reading)

    gallery, _ = Gallery.build(
        tmp_path / "g.igps",
        now(),
        small_interior(),
        n_workers=1,
    )
    before = {row["part"]: row["volume"] for row in gallery.rows("part", "volume")}
    assert sync(gallery, now(), tmp_path / "scans", n_workers=1) == (0, 0, [])
    table.write_text('{"1": "bar", "2": "block"}')
    assert sync(gallery, now(), tmp_path / "scans", n_workers=1) == (2, 0, [])
    after = {row["part"]: row["volume"] for row in gallery.rows("part", "volume")}
    assert after == {"block": before["bar"], "bar": before["block"]}


def test_a_column_with_a_dot_is_told_before_anything_is_described(root, tmp_path):
    (root / "labels.csv").write_text("file,label,scan.age\nball/0.off,ball,3\n")
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    words = r"labels.csv: expected column names without dots .* got 'scan.age'"
    with pytest.raises(ValueError, match=words):
        Gallery.build(tmp_path / "g.igps", dataset, small_interior(), n_workers=1)
    assert not (tmp_path / "g.igps").exists()


def test_a_column_with_a_name_of_the_engine_is_refused_before_it_spoils_the_gallery(
    root, dataset, tmp_path
):
    gallery, _ = Gallery.build(
        tmp_path / "g.igps",
        dataset,
        small_interior(),
        n_workers=1,
    )
    (root / "labels.csv").write_text("file,label,_rowid\nball/0.off,ball,3\n")
    words = r"labels.csv: .* do not begin with an underscore, got '_rowid'"
    changed = SignatureDataset(root, CONFIG, tmp_path / "cache")
    with pytest.raises(ValueError, match=words):
        gallery.add(changed, n_workers=1)
    with pytest.raises(ValueError, match=words):
        sync(gallery, changed, root)
    assert len(Gallery(tmp_path / "g.igps", small_interior())) == 6


def test_a_condition_is_read_to_its_end(dataset, tmp_path):
    """Any text after a valid condition is an error, since it may have been meant to restrict the condition."""
    gallery, _ = Gallery.build(
        tmp_path / "g.igps",
        dataset,
        small_interior(),
        n_workers=1,
    )
    where = "name = 'ball/0.off'"
    described = describe(dataset, small_interior())[:1]
    words = "where: expected a condition on the columns id, name"
    for rest in (" junk", ") OR (true", " LIMIT 1", "; DELETE FROM t", " -- note\n junk"):
        with pytest.raises(ValueError, match=words) as told:
            gallery.remove(where + rest)
        assert "/" not in str(told.value).partition("parser error")[2]
        with pytest.raises(ValueError, match=words):
            gallery.nearest(described, where=where + rest)
    assert [one["class"] for one in gallery.rows("class")].count("ball") == 3
    assert gallery.remove(f"({where}) -- a note") == 1


def test_a_folder_linked_twice_gives_each_body_once(root, tmp_path):
    """By the first of its names, whether it is built, added or synced."""
    (root / "zoo").symlink_to(root / "egg", target_is_directory=True)
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    names = sorted(name for name in dataset.bodies.names if not name.startswith("zoo"))
    assert len(names) == 6 < len(dataset)
    gallery, _ = Gallery.build(
        tmp_path / "g.igps",
        dataset,
        small_interior(),
        n_workers=1,
    )
    assert names_in(gallery) == names
    version = gallery.table.table.version
    assert sync(gallery, dataset, root, n_workers=1) == (0, 0, [])
    assert gallery.table.table.version == version
    gallery.remove("class = 'egg'")
    gallery.add(dataset, n_workers=1)
    assert names_in(gallery) == names


def test_a_gallery_is_no_file(dataset, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    words = r"notes.txt: expected a gallery or a new folder, got a file"
    with pytest.raises(ValueError, match=words):
        Gallery.build(tmp_path / "notes.txt", dataset, small_interior(), n_workers=1)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_sync_keeps_the_bodies_of_a_file_that_cannot_be_read(tmp_path):
    """When the file can be read again, bodies that it no longer holds are removed, and the others described again."""
    labels = block_and_bar()
    labels[11:22, 11:15, 5:9] = 3
    scan = tmp_path / "scans" / "scan.nii.gz"
    write_nifti(scan, labels)
    write_nifti(tmp_path / "scans" / "other.nii.gz", labels)
    reading = LoadOptions(bodies="labels")

    def now():
        return SignatureDataset(tmp_path / "scans", CONFIG, tmp_path / "cache", reading=reading)

    gallery, _ = Gallery.build(
        tmp_path / "g.igps",
        now(),
        small_interior(),
        n_workers=1,
    )
    scan.write_bytes(b"being copied")
    n_new, n_gone, (failure,) = sync(
        gallery,
        now(),
        tmp_path / "scans",
        n_workers=1,
    )
    assert n_new == 0
    assert n_gone == 0
    assert failure.id == "scan.nii.gz"
    assert len(gallery) == 6
    labels[labels == 3] = 0
    write_nifti(scan, labels)
    assert sync(gallery, now(), tmp_path / "scans", n_workers=1) == (2, 1, [])
    assert sorted(row["part"] for row in gallery.rows("part")) == ["1", "1", "2", "2", "3"]


def test_numbers_stay_as_they_are_written_in_a_column_of_text(root, tmp_path):
    table = "file,label,age\n0.off,a,{}\n1.off,a,{}\n2.off,a,\n"
    (root / "ball" / "labels.csv").write_text(table.format("old", "young"))
    (root / "egg" / "labels.csv").write_text(table.format("03", "4"))
    balls = SignatureDataset(root / "ball", CONFIG, tmp_path / "cache")
    eggs = SignatureDataset(root / "egg", CONFIG, tmp_path / "cache")
    gallery, _ = Gallery.build(
        tmp_path / "g.igps",
        balls,
        small_interior(),
        n_workers=1,
    )
    gallery.add(eggs, n_workers=1)
    assert {row["age"] for row in gallery.rows("age")} == {"old", "young", "03", "4", None}
    version = gallery.table.table.version
    assert sync(gallery, eggs, root / "egg", n_workers=1) == (0, 0, [])
    assert gallery.table.table.version == version


def test_what_labels_tell_no_more_sync_empties(root, tmp_path):
    table = root / "labels.csv"
    cache = tmp_path / "cache"
    table.write_text("file,label,age,scanner\nball/0.off,ball,41,A\negg/0.off,egg,3,B\n")
    dataset = SignatureDataset(root, CONFIG, cache)
    gallery, _ = Gallery.build(
        tmp_path / "g",
        dataset,
        small_interior(),
        n_workers=1,
    )
    table.write_text("file,label,scanner\nball/0.off,ball,A\negg/0.off,egg,C\n")
    found = sync(
        gallery,
        SignatureDataset(root, CONFIG, cache),
        root,
        n_workers=1,
    )
    assert found == (0, 0, [])
    ball, egg = sorted(
        gallery.rows("name", "age", "scanner"),
        key=lambda row: row["name"],
    )
    assert ball == {"name": "ball/0.off", "age": None, "scanner": "A"}
    assert egg == {"name": "egg/0.off", "age": None, "scanner": "C"}
    version = gallery.table.table.version
    sync(gallery, SignatureDataset(root, CONFIG, cache), root, n_workers=1)
    assert gallery.table.table.version == version


def test_a_gallery_that_cannot_be_built_is_told_before_anything_is_computed(
    root, tmp_path, nothing_is_computed, capsys
):
    words = ["gallery", "build", root, "--descriptor", INTERIOR]
    told = error_of(capsys, *words, "--out", root)
    assert "expected a gallery or a new folder, got a folder with ball" in told
    with_attribute = ["--out", tmp_path / "g", "--attribute", "ct=ct/{file}.nii.gz", "--with", "ct"]
    told = error_of(capsys, *words, *with_attribute)
    assert "ct: expected centres, got 8 quantiles that are not fitted" in told


def test_a_gallery_remembers_the_table_of_names(tmp_path, here, capsys):
    """As how files are read; another one may be given, as where it was moved to."""
    write_nifti(tmp_path / "scans" / "scan.nii.gz", block_and_bar())
    (tmp_path / "names.json").write_text('{"1": "block", "2": "bar"}')
    (tmp_path / "other.json").write_text('{"1": "cube", "2": "bar"}')
    cache = ["--cache_dir", "cache", "--n_workers", 1]
    build = ["gallery", "build", "scans", "--out", "g.igps", "--descriptor", INTERIOR, *SMALL]
    run(*build, "--size", "ignore", "--names", "names.json", *cache)
    (tmp_path / "elsewhere").mkdir()
    cache = ["--cache_dir", "../cache", "--n_workers", 1]
    query = ["query", "../scans/scan.nii.gz#bar", "--gallery", "../g.igps", "--top", 1]
    with contextlib.chdir(tmp_path / "elsewhere"):
        run(*query, *cache)
        assert "scan.nii.gz#bar" in capsys.readouterr().out
        sync_again = ["gallery", "sync", "../scans", "--gallery", "../g.igps", *cache]
        run(*sync_again)
        assert "0 bodies described, 0 removed" in capsys.readouterr().out
        run(*sync_again, "--names", "../other.json")
        assert "1 removed" in capsys.readouterr().out
    assert {row["part"] for row in Gallery("g.igps").rows("part")} == {"cube", "bar"}
