from __future__ import annotations

from pathlib import Path

import pytest

from igps.data.sources import bodies_of, file_and_part, find_bodies, given_bodies


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("")


def test_folder_per_class(tmp_path: Path) -> None:
    touch(tmp_path, "cat/2.off", "cat/1.off", "dog/deep/3.ply", "dog/readme.txt", ".hidden/4.off", "empty/5.txt")
    touch(tmp_path, "cat/.git/annex/1.off", "cat/._1.off", "__MACOSX/cat/._1.off")
    files = find_bodies(tmp_path)
    assert files.names == ("cat/1.off", "cat/2.off", "dog/deep/3.ply")
    assert files.labels == ("cat", "cat", "dog")
    assert files.paths[2] == tmp_path / "dog" / "deep" / "3.ply"


def test_labels_file_decides_what_belongs(tmp_path: Path) -> None:
    touch(tmp_path, "1.off", "2.off", "3.off")
    (tmp_path / "labels.csv").write_text("label,file\r\ncat,2.off\r\ndog,1.off\r\n")
    files = find_bodies(tmp_path)
    assert files.names == ("2.off", "1.off")
    assert files.labels == ("cat", "dog")


def test_meshes_alone_have_no_classes(tmp_path: Path) -> None:
    touch(tmp_path, "b.obj", "a.STL", "notes.json")
    files = find_bodies(tmp_path)
    assert files.names == ("a.STL", "b.obj")
    assert files.labels is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,class\n1.off,cat\n", "columns file,label"),
        ("", "columns file,label"),
        ("file,label\n", "no rows"),
        ("file,label,age,age\n1.off,cat,1,2\n", "named twice"),
        ("file,label\n1.off,cat\n2.off,\n", "line 3"),
        ("file,label\n\n1.off,cat\n\n2.off,\n", "line 5"),
        ("file;label\n1.off;cat\n", "parted by a comma"),
        ("file,label\n1.off,Wölfe\n", "CSV in UTF-8"),
        (f"file,label\n1.off,{'x' * 200_000}\n", "not readable as a table"),
        ("file,label\n1.off,cat\n1.off,dog\n", r"1\.off is listed twice"),
    ],
)
def test_bad_labels_file(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "labels.csv").write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=rf"labels\.csv: .*{message}"):
        find_bodies(tmp_path)


def test_blanks_around_the_words_of_a_table_make_no_other_class(tmp_path: Path) -> None:
    touch(tmp_path, "1.off", "2.off")
    (tmp_path / "labels.csv").write_text("file, label, age\n1.off, cat, 3\n2.off ,cat \n")
    found = find_bodies(tmp_path)
    assert found.names == ("1.off", "2.off")
    assert found.labels == ("cat", "cat")
    assert found.columns == {"age": ("3", None)}


def test_a_part_is_told_from_a_folder_with_its_mark(tmp_path: Path) -> None:
    touch(tmp_path, "case #1/a.obj", "case #1/b#2.obj")
    folder = tmp_path / "case #1"
    assert file_and_part(folder / "a.obj#liver") == (folder / "a.obj", "liver")
    assert file_and_part(folder / "a.obj#liver#2") == (folder / "a.obj", "liver#2")
    assert file_and_part(folder / "b#2.obj#liver") == (folder / "b#2.obj", "liver")
    assert file_and_part(folder / "b#2.obj") == (folder / "b#2.obj", None)


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no mesh found"):
        find_bodies(tmp_path)
    with pytest.raises(FileNotFoundError, match="no such folder"):
        find_bodies(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"nowhere: no such file or folder\. Check the path\."):
        bodies_of(tmp_path / "nowhere")


def test_given_files_need_one_label_each() -> None:
    assert given_bodies(["b.off", "a.off"], ["x", "y"]).labels == ("x", "y")
    with pytest.raises(ValueError, match="labels: expected one for each of 2"):
        given_bodies(["b.off", "a.off"], ["x"])
    with pytest.raises(ValueError, match="at least one"):
        given_bodies([])
