import os
from pathlib import Path

import numpy as np
import pytest

from igps.data.sources import bodies_of, bodies_of_files, file_and_part, find_bodies


def touch(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("")


def test_folder_per_class(tmp_path):
    touch(
        tmp_path,
        "cat/2.off",
        "cat/1.off",
        "dog/deep/3.ply",
        "dog/readme.txt",
        ".hidden/4.off",
        "empty/5.txt",
    )
    touch(tmp_path, "cat/.git/annex/1.off", "cat/._1.off", "__MACOSX/cat/._1.off")
    files = find_bodies(tmp_path)
    assert files.names == ("cat/1.off", "cat/2.off", "dog/deep/3.ply")
    assert files.labels == ("cat", "cat", "dog")
    assert files.paths[2] == tmp_path / "dog" / "deep" / "3.ply"


def test_labels_file_decides_what_belongs(tmp_path):
    touch(tmp_path, "1.off", "2.off", "3.off")
    (tmp_path / "labels.csv").write_text("label,file\r\ncat,2.off\r\ndog,1.off\r\n")
    files = find_bodies(tmp_path)
    assert files.names == ("2.off", "1.off")
    assert files.labels == ("cat", "dog")


def test_meshes_alone_have_no_classes(tmp_path):
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
        ("name;label\n1.off;cat\n", "separated by commas"),
        (f"file,label\n1.off,{'x' * 200_000}\n", "not readable as a table"),
        ("file,label\n1.off,cat\n1.off,dog\n", r"1\.off is listed twice"),
        ("file,label\n1.off,cat\na/../1.off,cat\n", r"1\.off is listed twice"),
        ("file,label\n1\0.off,cat\n", "line 2 lacks the name of a file"),
        (
            "file,label,age\n1.off,cat,40,5\n",
            "line 2 has more values than columns. Put a value with a comma in quotes",
        ),
    ],
)
def test_bad_labels_file(tmp_path, text, message):
    (tmp_path / "labels.csv").write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=rf"labels\.csv: .*{message}"):
        find_bodies(tmp_path)


@pytest.mark.parametrize(
    ("encoding", "separator"),
    [("utf-8", ","), ("utf-8-sig", ";"), ("utf-16", "\t"), ("cp1252", ";")],
)
def test_tables_as_spreadsheets_save_them(tmp_path, encoding, separator):
    touch(tmp_path, "1.off", "2.off")
    rows = [("File", "Label", "Alter"), ("1.off", "Wölfe", "3"), ("2.off", "cat", "4")]
    text = "".join(separator.join(row) + "\r\n" for row in rows)
    (tmp_path / "labels.csv").write_bytes(text.encode(encoding))
    found = find_bodies(tmp_path)
    assert found.labels == ("Wölfe", "cat")
    assert found.columns == {"Alter": ("3", "4")}


def test_blanks_around_the_words_of_a_table_make_no_other_class(tmp_path):
    touch(tmp_path, "1.off", "2.off")
    (tmp_path / "labels.csv").write_text("file, label, age\n1.off, cat, 3\n2.off ,cat \n")
    found = find_bodies(tmp_path)
    assert found.names == ("1.off", "2.off")
    assert found.labels == ("cat", "cat")
    assert found.columns == {"age": ("3", None)}


def test_a_part_is_told_from_a_folder_with_its_mark(tmp_path):
    touch(tmp_path, "case #1/a.obj", "case #1/b#2.obj")
    folder = tmp_path / "case #1"
    assert file_and_part(folder / "a.obj#liver") == (folder / "a.obj", "liver")
    assert file_and_part(folder / "a.obj#liver#2") == (folder / "a.obj", "liver#2")
    assert file_and_part(folder / "b#2.obj#liver") == (folder / "b#2.obj", "liver")
    assert file_and_part(folder / "b#2.obj") == (folder / "b#2.obj", None)
    # No name of a file is as long
    long = 300 * "x"
    assert file_and_part(folder / f"a.obj#{long}") == (folder / "a.obj", long)


def test_what_is_left_out_of_a_folder_is_told(tmp_path, caplog):
    touch(tmp_path, "cat/1.off", "alone.off")
    # As of a file that was not fetched
    (tmp_path / "cat" / "lost.off").symlink_to(tmp_path / "not there.off")
    (tmp_path / "elsewhere").mkdir()
    touch(tmp_path / "elsewhere", "5.off")
    (tmp_path / "linked").symlink_to(tmp_path / "elsewhere")
    os.mkfifo(tmp_path / "cat" / "pipe.off")
    Path(os.fsdecode(os.fsencode(tmp_path / "cat") + b"/m\xfcll.off")).write_text("")
    files = find_bodies(tmp_path)
    assert files.names == ("cat/1.off", "cat/lost.off", "elsewhere/5.off", "linked/5.off")
    assert files.labels == ("cat", "cat", "elsewhere", "linked")
    assert r"m\xfcll.off': left out, its name is not UTF-8" in caplog.text
    assert "1 files beside the folders of classes are ignored, such as alone.off" in caplog.text
    assert len(caplog.records) == 2


def test_names_that_are_no_words_are_refused(tmp_path):
    name = Path(os.fsdecode(os.fsencode(tmp_path) + b"/m\xfcll"))
    touch(name, "1.off")
    with pytest.raises(ValueError, match=r"m\\xfcll': expected a name in UTF-8"):
        find_bodies(name)
    with pytest.raises(
        ValueError, match=r"paths: expected names in UTF-8, got b'.*m\\xfcll/1.off'"
    ):
        bodies_of_files([name / "1.off"])


def test_labels_may_be_an_array_and_are_of_files_alone(tmp_path):
    touch(tmp_path, "cat/1.off", "dog/2.off")
    paths = [tmp_path / "cat" / "1.off", tmp_path / "dog" / "2.off"]
    assert bodies_of(paths, np.array(["x", "y"])).labels == ("x", "y")
    for given in (tmp_path, find_bodies(tmp_path)):
        with pytest.raises(ValueError, match="labels: expected None with a folder or bodies"):
            bodies_of(given, ["x", "y"])


def test_nothing_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="no body found"):
        find_bodies(tmp_path)
    with pytest.raises(FileNotFoundError, match="no such folder"):
        find_bodies(tmp_path / "nowhere")
    with pytest.raises(
        FileNotFoundError, match=r"nowhere: no such file or folder\. Check the path\."
    ):
        bodies_of(tmp_path / "nowhere")


def test_given_files_need_one_label_each():
    assert bodies_of_files(["b.off", "a.off"], ["x", "y"]).labels == ("x", "y")
    with pytest.raises(ValueError, match="labels: expected one for each of 2"):
        bodies_of_files(["b.off", "a.off"], ["x"])
    with pytest.raises(ValueError, match="at least one"):
        bodies_of_files([])
