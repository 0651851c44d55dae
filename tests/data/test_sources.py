from __future__ import annotations

from pathlib import Path

import pytest

from igps.data.sources import find_bodies, given_bodies


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("")


def test_folder_per_class(tmp_path: Path) -> None:
    touch(tmp_path, "cat/2.off", "cat/1.off", "dog/deep/3.ply", "dog/readme.txt", ".hidden/4.off", "empty/5.txt")
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
        ("file,label\n1.off,cat\n1.off,dog\n", r"1\.off is listed twice"),
    ],
)
def test_bad_labels_file(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "labels.csv").write_text(text)
    with pytest.raises(ValueError, match=rf"labels\.csv: .*{message}"):
        find_bodies(tmp_path)


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no mesh found"):
        find_bodies(tmp_path)
    with pytest.raises(FileNotFoundError, match="no such folder"):
        find_bodies(tmp_path / "nowhere")


def test_given_files_need_one_label_each() -> None:
    assert given_bodies(["b.off", "a.off"], ["x", "y"]).labels == ("x", "y")
    with pytest.raises(ValueError, match="labels: expected one for each of 2"):
        given_bodies(["b.off", "a.off"], ["x"])
    with pytest.raises(ValueError, match="at least one"):
        given_bodies([])
