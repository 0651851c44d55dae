"""Rows of a gallery against the comparison with all of them."""

import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

pytest.importorskip("lancedb", reason="the extra [index]")

import lancedb
import pyarrow as pa

from igps.gallery.about import check_alike
from igps.gallery.opening import is_gallery
from igps.gallery.place import address
from igps.gallery.table import BodyTable, write
from igps.retrieval import chi_square, cosine, search

ABOUT = {"descriptor": "test", "signature": {"resolution": 32}}
FURTHER = {"age": float}


def histograms(n, n_cells=300, seed=0):
    """Histograms of sum 1, in families of twenty."""
    generator = np.random.default_rng(seed)
    families = generator.gamma(0.5, size=(n // 20 + 1, n_cells)).repeat(20, axis=0)[:n]
    found = families * generator.gamma(20, size=families.shape)
    return torch.from_numpy((found / found.sum(axis=1, keepdims=True)).astype(np.float32))


def units(n, width=16, seed=0):
    found = torch.randn(
        n,
        width,
        generator=torch.Generator().manual_seed(seed),
    )
    return torch.nn.functional.normalize(found, dim=1)


def told(number, mark="a"):
    label = "odd" if number % 2 else None
    return {
        "id": f"{number:05}",
        "name": f"mesh {number}",
        "class": label,
        "checksum": mark,
        "volume": 2.0 * number,
        "age": float(number % 90),
    }


def batches(rows, first=0, mark="a"):
    for start in range(0, len(rows), 700):
        part = rows[start : start + 700]
        yield part, [told(first + start + i, mark) for i in range(len(part))]


def written(path, rows, searched_by, mark="a"):
    write(path, ABOUT, searched_by, batches(rows, mark=mark), FURTHER)
    return BodyTable(path)


def numbers(found):
    return [int(row["id"]) for row in found[0]]


def recall(table, asked, rows, distance, **options):
    exact = search(asked, rows, top=10, distance=distance).indices.tolist()
    n_found = 0
    for one, nearest in zip(asked, exact, strict=True):
        found = numbers(
            table.nearest(
                one[None],
                distance,
                top=10,
                **options,
            )
        )
        n_found += len(set(found) & set(nearest))
    return n_found / (10 * len(asked))


@pytest.mark.parametrize("searched_by", ["chi_square", None])
def test_few_are_compared_one_by_one(tmp_path, searched_by):
    rows = histograms(90, 12).reshape(90, 3, 4)
    table = written(tmp_path / "g.igps", rows, searched_by)
    expected = search(rows[:5], rows, top=7)
    for i in range(5):
        found = table.nearest(
            rows[i : i + 1],
            chi_square,
            top=7,
        )
        assert numbers(found) == expected.indices[i].tolist()
        assert_close(
            found[1],
            expected.distances[i],
            rtol=1e-6,
            atol=1e-7,
        )
        assert torch.equal(found[2], rows[expected.indices[i]])
    assert {name: found[0][0][name] for name in told(4)} == told(4)
    assert len(table) == 90


def test_the_nearest_of_many_are_those_of_all(tmp_path):
    rows = histograms(4500)
    asked = rows[::150]
    table = written(tmp_path / "g.igps", rows, "chi_square")
    assert recall(table, asked, rows, chi_square, candidates=200) >= 0.98
    exact = search(asked[:3], rows, top=10)
    for i in range(3):
        found = table.nearest(
            asked[i : i + 1],
            chi_square,
            top=10,
            exact=True,
        )
        assert numbers(found) == exact.indices[i].tolist()
        assert_close(found[1], exact.distances[i], rtol=1e-5, atol=1e-6)


def test_a_condition_keeps_what_numpy_keeps(tmp_path):
    """The nearest among those that satisfy it, where it keeps many, one in a hundred, few and none."""
    rows = units(4500)
    every = np.arange(4500)
    table = written(tmp_path / "g.igps", rows, "cosine")
    begins_with_one = np.array([str(i)[0] == "1" for i in every])
    for where, kept in (
        ("class = 'odd' AND volume > 3000", (every % 2 == 1) & (2 * every > 3000)),
        ("age = 17", every % 90 == 17),
        ("id IN ('00004', '02222')", (every == 4) | (every == 2222)),
        ("class IS NULL AND name LIKE 'mesh 1%'", (every % 2 == 0) & begins_with_one),
        ("age > 1000", every < 0),
    ):
        left = np.flatnonzero(kept)
        query = rows[1]
        order = torch.sort(1 - rows[left] @ query, stable=True).indices[:10]
        expected = left[order.numpy()].tolist()
        for exact in (False, True):
            found = table.nearest(
                query[None],
                cosine,
                top=10,
                where=where,
                exact=exact,
            )
            assert numbers(found) == expected, where
    words = r"where: expected a condition on the columns id, name, .* age, got"
    for wrong in ("weight > 3", "volume >", "volume > 'much' AND"):
        for exact in (False, True):
            with pytest.raises(ValueError, match=words):
                table.nearest(
                    rows[:1],
                    cosine,
                    top=1,
                    where=wrong,
                    exact=exact,
                )


def test_vectors_of_any_length_are_searched(tmp_path):
    """More may be wanted than are near."""
    rows = units(4500, width=21)
    table = written(tmp_path / "g.igps", rows, "cosine")
    assert recall(table, rows[:40], rows, cosine) == 1
    (expected,) = search(rows[:1], rows, top=1500, distance=cosine).indices.tolist()
    assert numbers(table.nearest(rows[:1], cosine, top=1500)) == expected


def test_long_descriptions_are_kept_in_half_precision(tmp_path):
    """Each number to 0.05 %, however small all of them are."""
    rows = histograms(60, 1500)
    rows[7] *= 1e-9
    rows[8] = 0
    table = written(tmp_path / "g.igps", rows, "chi_square")
    assert str(table.table.schema.field("vector").type) == "fixed_size_list<item: halffloat>[1501]"
    kept = torch.cat([table.decoded(some)[0] for some in table.batches()])
    assert_close(kept, rows, rtol=2**-11, atol=1e-11)
    found = table.nearest(rows[:1], chi_square, top=5)
    expected = search(rows[:1], rows, top=5).distances[0]
    assert_close(found[1], expected, rtol=2e-3, atol=1e-6)


def test_rows_are_added_replaced_and_removed(tmp_path):
    """However the rows came, the answers are those of all rows at once; a new column is empty before."""
    rows = units(5000)
    table = written(tmp_path / "g.igps", rows[:2400], "cosine")
    assert "short" not in table.table.schema.names
    # The second addition makes the table large enough for short vectors and an index
    for start in (2400, 3600):
        table.add(
            rows[start : start + 1200],
            [told(start + i) for i in range(1200)],
            {"site": str},
        )
    assert {"id", "site", "short"} <= {index.columns[0] for index in table.table.list_indices()}
    assert table.columns["site"] is str
    changed = rows[4800:]
    table.add(
        changed,
        [{**told(i, "b"), "site": "A"} for i in range(200)],
        {"site": str},
    )
    assert len(table) == 4800
    assert len(table.table.search().where("site = 'A'").to_list()) == 200
    with table.changing() as engine:
        engine.delete("id < '00100'")
    now = torch.cat([changed[100:], rows[200:4800]])
    for query in now[::600]:
        expected = search(query[None], now, top=6, distance=cosine).indices[0] + 100
        found = BodyTable(table.path).nearest(
            query[None],
            cosine,
            top=6,
        )
        assert numbers(found) == expected.tolist()
    with pytest.raises(ValueError, match=r"age: expected numbers as in .*g\.igps, got text"):
        table.add(
            rows[:1],
            [{**told(0), "age": "old"}],
            {"age": str},
        )


def test_weighted_numbers_decide_which_rows_are_candidates(tmp_path):
    """By a distance of the last two numbers alone, the nearest rows are not those by the cosine of all."""
    rows = units(4500, 40)

    def distance(queries, gallery):
        return torch.cdist(
            queries[:, 38:],
            gallery[:, 38:],
        )

    def weights(width):
        return [0.1] * (width - 2) + [9.0] * 2

    plain = written(tmp_path / "plain.igps", rows, "cosine")
    path = tmp_path / "weighted.igps"
    write(path, ABOUT, "cosine", batches(rows), FURTHER, weights=weights)
    assert (
        recall(
            plain,
            rows[:20],
            rows,
            distance,
            candidates=60,
        )
        < 0.5
    )
    assert (
        recall(
            BodyTable(path),
            rows[:20],
            rows,
            distance,
            candidates=60,
        )
        >= 0.98
    )


def test_versions_are_those_of_the_engine(tmp_path):
    """An earlier version, also one with another map to short vectors, is restored and searched."""
    rows = units(4500)
    table = written(tmp_path / "g.igps", rows, "cosine")
    first = table.table.version
    written(tmp_path / "g.igps", histograms(4200, 300), "chi_square")
    assert len(BodyTable(table.path)) == 4200
    lancedb.connect(table.path).open_table("bodies").restore(first)
    restored = BodyTable(table.path)
    assert len(restored) == 4500
    found = numbers(
        restored.nearest(
            rows[29:30],
            cosine,
            top=1,
        )
    )
    assert found == [29]


def test_a_gallery_lies_in_an_object_store(tmp_path):
    """By the protocol that object stores share; here the store is a folder."""
    place = f"file-object-store://{tmp_path}/store/g.igps"
    assert not is_gallery(place)
    rows = units(4500)
    write(place, ABOUT, "cosine", batches(rows), FURTHER)
    assert is_gallery(place)
    table = BodyTable(place)
    table.add(
        rows[:10],
        [told(i, "b") for i in range(10)],
        {},
    )
    assert len(BodyTable(place)) == 4500
    found = numbers(
        BodyTable(place).nearest(
            rows[7:8],
            cosine,
            top=1,
        )
    )
    assert found == [7]


def test_a_path_keeps_the_place_in_a_bucket():
    assert address(Path("s3://bucket/all/g.igps")) == "s3://bucket/all/g.igps"
    assert address("gs://bucket/g.igps") == "gs://bucket/g.igps"
    assert address(Path("C:/meshes/g.igps")) == "C:/meshes/g.igps"


def test_what_is_no_gallery_of_this_kind_is_refused(tmp_path):
    table = written(tmp_path / "g.igps", units(10), "cosine")
    other = {"descriptor": "test", "signature": {"resolution": 20}}
    words = r"g\.igps: expected a gallery with signature\.resolution 20, got 32"
    with pytest.raises(ValueError, match=words):
        check_alike(table.path, table.about, other)
    words = r"descriptions: expected shape \(16,\) as in .*, got "
    with pytest.raises(ValueError, match=words + r"\(5,\)"):
        table.nearest(units(1, 5), cosine, top=1)
    with pytest.raises(ValueError, match=words + r"\(4, 4\)"):
        table.add(
            units(1).reshape(1, 4, 4),
            [told(0)],
            {},
        )
    with pytest.raises(ValueError, match="expected finite numbers"):
        table.add(units(1) / 0, [told(0)], {})
    with pytest.raises(ValueError, match="at least one for the gallery"):
        write(tmp_path / "new.igps", ABOUT, "cosine", [], {})
    with pytest.raises(FileNotFoundError, match=r"nowhere: no gallery there"):
        BodyTable(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"got a folder with g.igps"):
        written(tmp_path, units(10), "cosine")
    assert len(BodyTable(tmp_path / "g.igps")) == 10


def test_a_strangers_gallery_runs_nothing(tmp_path):
    """LanceDB would load the model that a table names; a head that does not fit is told in a sentence."""
    damages = (("embedding_functions", b"[]"), ("gallery", b"{"), ("gallery", b"[1]"))
    for number, (name, value) in enumerate(damages):
        table = written(tmp_path / f"{number}.igps", units(3), "cosine")
        head = {
            **table.table.to_arrow().schema.metadata,
            name.encode(): value,
        }
        with_head(table, head)
        with pytest.raises(ValueError, match=r"\d\.igps: the gallery is damaged\. Restore"):
            BodyTable(table.path)
    table = written(tmp_path / "map.igps", units(3), "cosine")
    lancedb.connect(table.path).create_table(
        "map-x",
        pa.table({"arrays": [b"\x80\x04N."]}),
    )
    head = table.table.to_arrow().schema.metadata[b"gallery"]
    with_head(table, {b"gallery": head.replace(b'"map": null', b'"map": "map-x"')})
    with pytest.raises(ValueError, match=r"map\.igps: the gallery is damaged.*pickle"):
        BodyTable(table.path)


def with_head(table, metadata):
    """Store the rows with another head, as a stranger could."""
    changed = table.table.to_arrow().replace_schema_metadata(metadata)
    lancedb.connect(table.path).create_table("bodies", changed, mode="overwrite")


@pytest.mark.parametrize("how", ["truncated", "gone", "empty"])
def test_no_damaged_file_gives_a_wrong_answer(tmp_path, how):
    """The damage is an error in a sentence, or the answer is right without the file."""
    rows = units(4500)
    path = tmp_path / "g.igps"
    written(path, rows, "cosine")
    right = numbers(
        BodyTable(path).nearest(
            rows[:1],
            cosine,
            top=3,
        )
    )
    files = [file for file in path.rglob("*") if file.is_file() and file.name != "lock"]
    # One file of each kind in each folder
    chosen = {(file.parent, file.suffix): file for file in files}
    n_refused = 0
    for file in chosen.values():
        content = file.read_bytes()
        if how == "gone":
            file.unlink()
        else:
            n_bytes = len(content) // 2 if how == "truncated" else 0
            file.write_bytes(content[:n_bytes])
        error = ""
        try:
            assert (
                numbers(
                    BodyTable(path).nearest(
                        rows[:1],
                        cosine,
                        top=3,
                    )
                )
                == right
            ), file
        except (ValueError, FileNotFoundError) as refusal:
            error = str(refusal)
            n_refused += 1
        assert not error or "g.igps" in error
        assert "\n" not in error
        file.write_bytes(content)
    assert n_refused >= 3
    found = numbers(
        BodyTable(path).nearest(
            rows[:1],
            cosine,
            top=3,
        )
    )
    assert found == right


def _answers(path):
    """The three nearest of each of ten rows."""
    table = path if isinstance(path, BodyTable) else BodyTable(path)
    return [numbers(table.nearest(one[None], cosine, top=3)) for one in units(1500)[::150]]


def test_several_processes_read_while_one_adds(tmp_path):
    rows = units(1500)
    table = written(tmp_path / "g.igps", rows[:1300], "cosine")
    opened = BodyTable(table.path)
    before = _answers(table.path)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(_answers, table.path) for _ in range(6)]
        table.add(
            rows[1300:],
            [told(i) for i in range(1300, 1500)],
            {},
        )
        after = _answers(table.path)
        for future in futures:
            assert future.result() in (before, after)
    # What was opened before stays what it was.
    assert _answers(opened) == before
    assert before != after


_WRITER = """
import sys
sys.path[:0] = [{tests!r}]
from test_table import BodyTable, told, units
table = BodyTable({folder!r})
who = int(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
for turn in range(1000):
    mark, first = f"{{who}}-{{turn}}", 1000 * who
    table.add(units(40, seed=turn), [told(first + i, mark) for i in range(40)], {{}})
    with table.changing() as engine:
        engine.update(where=f"id >= '{{first:05}}' AND id < '{{first + 20:05}}'", values={{"class": mark}})
    with table.changing() as engine:
        engine.delete(f"id >= '{{first + 30:05}}' AND id < '{{first + 40:05}}'")
"""


def killed_writers(folder, n_kills, longest=0.25):
    """Kill two processes while they add, update and remove rows; return how often a change was stored in part.

    Each writer has separate rows. A turn writes 40 rows, then updates the class of 20, then removes 10; any state
    between these changes is whole.
    """
    written(folder, units(50, seed=1), "cosine", mark="still")
    wrong = 0
    generator = random.Random(0)
    words = _WRITER.format(
        tests=str(Path(__file__).parent),
        folder=str(folder),
    )
    for _ in range(n_kills):
        both = []
        for who in ("1", "2"):
            command = [sys.executable, "-c", words, who]
            both.append(
                subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                )
            )
        for child in both:
            child.stdout.readline()
        for child in both:
            child.stdin.write(b"go\n")
            child.stdin.flush()
        for child in both:
            time.sleep(generator.uniform(0, longest))
            os.kill(child.pid, signal.SIGKILL)
            child.communicate()
        wrong += not is_whole(BodyTable(folder))
    return wrong


def is_whole(table):
    rows = []
    for some in table.batches():
        rows += zip(*table.decoded(some), strict=True)
    still = {row["id"]: values for values, row in rows if row["checksum"] == "still"}
    if len(still) != 50:
        return False
    in_order = torch.stack([still[f"{i:05}"] for i in range(50)])
    if not torch.equal(in_order, units(50, seed=1)):
        return False
    return all(is_whole_of_writer(who, rows) for who in (1, 2))


def is_whole_of_writer(who, rows):
    own = [(row, values) for values, row in rows if row["id"].startswith(f"0{who}")]
    own.sort(key=lambda one: one[0]["id"])
    if not own:
        return True
    marks = {row["checksum"] for row, _ in own}
    if len(own) not in (30, 40) or len(marks) > 1:
        return False
    (mark,) = marks
    classes = {row["class"] for row, _ in own[:20]}
    is_updated = classes == {mark}
    is_new = classes <= {"odd", None} and len(own) == 40
    expected = units(40, seed=int(mark.partition("-")[2]))[: len(own)]
    is_equal = torch.equal(
        torch.stack([values for _, values in own]),
        expected,
    )
    return (is_updated or is_new) and is_equal


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL")
def test_kills_of_two_writers_leave_whole_changes(tmp_path):
    assert killed_writers(tmp_path / "g.igps", 1, longest=0.8) == 0
    rows = BodyTable(tmp_path / "g.igps").table.to_arrow()
    assert len(set(rows["checksum"].to_pylist())) > 1


def test_is_whole_detects_a_change_stored_in_part(tmp_path):
    """The check of the test above can fail."""
    table = written(tmp_path / "g.igps", units(50, seed=1), "cosine", mark="still")
    table.add(
        units(40, seed=3),
        [told(1000 + i, "1-3") for i in range(40)],
        {},
    )
    assert is_whole(table)
    table.add(
        units(7, seed=3),
        [told(1000 + i, "1-4") for i in range(7)],
        {},
    )
    assert not is_whole(table)
