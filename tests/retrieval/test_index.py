from __future__ import annotations

import json
import multiprocessing
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from scipy.stats import spearmanr

from igps.retrieval import chi_square, cosine, index_part, search
from igps.retrieval import index as index_module
from igps.retrieval.index import Entry, VectorIndex, extend_index, merge_indices, write_index
from igps.retrieval.vectors import VectorMap

pytest.importorskip("faiss")
pytest.importorskip("filelock")

ABOUT = {"descriptor": "test", "signature": {"resolution": 32}}


def histograms(n: int, n_cells: int = 300, seed: int = 0) -> torch.Tensor:
    """Histograms of sum 1, in families of twenty."""
    generator = np.random.default_rng(seed)
    families = generator.gamma(0.5, size=(n // 20 + 1, n_cells)).repeat(20, axis=0)[:n]
    found = families * generator.gamma(20, size=families.shape)
    return torch.from_numpy((found / found.sum(axis=1, keepdims=True)).astype(np.float32))


def units(n: int, width: int = 16, seed: int = 0) -> torch.Tensor:
    found = torch.randn(n, width, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(found, dim=1)


def batches(rows: torch.Tensor, first: int = 0, mark: str = "a") -> Iterator[tuple[torch.Tensor, list[Entry]]]:
    for start in range(0, len(rows), 700):
        part = rows[start : start + 700]
        names = [str(first + start + i) for i in range(len(part))]
        yield part, [Entry(name, f"mesh {name}", "odd" if int(name) % 2 else None, mark) for name in names]


def names(index: VectorIndex, indices: torch.Tensor) -> list[list[str]]:
    return [[entry.id for entry in index.entries(row.numpy())] for row in indices]


@pytest.mark.parametrize("searched_by", ["chi_square", None])
def test_few_are_compared_one_by_one(tmp_path: Path, searched_by: str | None) -> None:
    rows = histograms(90, 12).reshape(90, 3, 4)
    index = write_index(tmp_path / "g.igps", ABOUT, searched_by, batches(rows))  # type: ignore[arg-type]
    expected = search(rows[:5], rows, top=7)
    found = index.search(rows[:5], chi_square, top=7)
    assert names(index, found.indices) == [[str(i) for i in row] for row in expected.indices.tolist()]
    assert torch.equal(found.distances, expected.distances)
    assert index.entries([3, 2]) == [Entry("3", "mesh 3", "odd", "a"), Entry("2", "mesh 2", None, "a")]
    assert len(index) == 90


@pytest.mark.parametrize("clusters", [False, True])
def test_the_nearest_of_many_are_those_of_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clusters: bool) -> None:
    """By short vectors alone, and by clusters of them."""
    if clusters:
        monkeypatch.setattr(index_part, "_MOST_FLAT", 1000)
    rows, asked = histograms(3000), histograms(3000)[::75]
    index = write_index(tmp_path / "g.igps", ABOUT, "chi_square", batches(rows))
    assert bool(list(index.path.rglob("*.faiss"))) == clusters
    found = index.search(asked, chi_square, top=10, candidates=200)
    exact = search(asked, rows, top=10)
    pairs = zip(names(index, found.indices), exact.indices.tolist(), strict=True)
    assert np.mean([len(set(one) & set(map(str, other))) for one, other in pairs]) >= 9.8
    # Kept in half precision, each number to 0.05 %.
    torch.testing.assert_close(
        index.search(asked, chi_square, top=10, exact=True).distances, exact.distances, rtol=2e-3, atol=1e-6
    )


def test_clusters_take_vectors_of_any_length(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Zeros behind them, which FAISS wants to be quick, change no distance."""
    monkeypatch.setattr(index_part, "_MOST_FLAT", 1000)
    monkeypatch.setattr(index_part, "_PROBED", 4096)
    rows = units(2000, width=21)
    index = write_index(tmp_path / "g.igps", ABOUT, "cosine", batches(rows))
    assert list(index.path.rglob("*.faiss"))
    found = index.search(rows[:40], cosine, top=10, candidates=60)
    exact = search(rows[:40], rows, top=10, distance=cosine)
    torch.testing.assert_close(found.distances, exact.distances, rtol=0, atol=1e-6)


def test_bars_tell_how_far_the_short_vectors_and_clusters_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(index_part, "_MOST_FLAT", 1000)
    rows = histograms(3000)
    write_index(tmp_path / "silent.igps", ABOUT, "chi_square", batches(rows))
    assert capsys.readouterr() == ("", "")
    write_index(tmp_path / "g.igps", ABOUT, "chi_square", batches(rows), progress=True)
    told = capsys.readouterr()
    assert told.out == ""
    full = re.findall(r"([\w ]+): 100%\|[^|]*\| (\d+)/", told.err)
    assert list(dict.fromkeys(full)) == [("short vectors", "3000"), ("clusters", "3000")]


def test_more_may_be_wanted_than_are_near(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_part, "_MOST_FLAT", 1000)
    monkeypatch.setattr(index_part, "_PROBED", 1)
    rows = units(2000)
    index = write_index(tmp_path / "g.igps", ABOUT, "cosine", batches(rows))
    found = index.search(rows[:3], cosine, top=1500)
    assert torch.equal(found.indices, search(rows[:3], rows, top=1500, distance=cosine).indices)


def test_long_descriptions_are_kept_in_half_precision(tmp_path: Path) -> None:
    """Each number to 0.05 %, however small all of them are."""
    rows = histograms(60, 1500)
    rows[7] *= 1e-9
    rows[8] = 0
    index = write_index(tmp_path / "g.igps", ABOUT, "chi_square", batches(rows))
    assert sum(file.stat().st_size for file in index.path.rglob("descriptions.raw")) == 60 * 1500 * 2
    (_, kept), *_ = index.batches()
    torch.testing.assert_close(kept, rows, rtol=2**-11, atol=1e-11)
    found = index.search(rows, chi_square, top=5)
    torch.testing.assert_close(found.distances, search(rows, rows, top=5).distances, rtol=2e-3, atol=1e-6)


def test_features_order_as_chi_square_does() -> None:
    """By a fifth to a third less, the more the closer, and in nearly the same order."""
    rows = histograms(120, 500)
    vectors = VectorMap.fit(rows.numpy(), "chi_square")(rows.numpy())
    assert vectors.shape[1] <= 256
    a, b = rows[:, None].double(), rows[None].double()
    expected = ((a - b) ** 2 / (a + b).clamp_min(1e-300)).sum(2) / 2
    apart = ~np.eye(120, dtype=bool)
    found = cdist(vectors, vectors)[apart] ** 2 / 2
    ratio = found / expected[apart].numpy()
    assert ratio.min() > 0.63
    assert ratio.max() < 0.9
    assert spearmanr(found, expected[apart].numpy())[0] > 0.995


def test_short_unit_vectors_stay_what_they_are(tmp_path: Path) -> None:
    rows = units(2500)
    index = write_index(tmp_path / "g.igps", ABOUT, "cosine", batches(rows))
    assert index.vector_map is not None
    assert not index.vector_map.changes
    found = index.search(rows[:30], cosine, top=5)
    expected = torch.sort(1 - rows[:30].double() @ rows.double().T, dim=1).indices[:, :5]
    assert names(index, found.indices) == [[str(i) for i in row] for row in expected.tolist()]
    np.testing.assert_array_equal(found.distances[:, 0], 0)


def test_long_unit_vectors_are_reduced(tmp_path: Path) -> None:
    rows = torch.nn.functional.normalize(histograms(1500, 700).sqrt(), dim=1)
    index = write_index(tmp_path / "g.igps", ABOUT, "cosine", batches(rows))
    assert index.vector_map is not None
    assert index.vector_map(rows[:1].numpy()).shape == (1, 256)
    found = index.search(rows[:40], cosine, top=10, candidates=200)
    expected = torch.sort(1 - rows[:40] @ rows.T, dim=1, stable=True).indices[:, :10]
    pairs = zip(names(index, found.indices), expected.tolist(), strict=True)
    assert np.mean([len(set(one) & set(map(str, other))) for one, other in pairs]) >= 9.8


def test_parts_are_added_joined_and_merged(tmp_path: Path) -> None:
    """Whatever the way they came, the answers are those of all at once."""
    rows = units(3200)
    index = write_index(tmp_path / "a.igps", ABOUT, "cosine", batches(rows[:40]))
    for start in range(40, 1600, 40):
        index = extend_index(index.path, ABOUT, batches(rows[start : start + 40], start))
    assert len(index.parts) <= np.log2(1600)
    assert len(list(index.path.glob("part-*"))) == len(index.parts)
    write_index(tmp_path / "b.igps", ABOUT, "cosine", batches(rows[1500:], 1500))
    merged = merge_indices(tmp_path / "c.igps", [tmp_path / "a.igps", tmp_path / "b.igps"])
    assert (len(index), len(merged), len(VectorIndex(tmp_path / "b.igps"))) == (1600, 3200, 1700)
    whole = write_index(tmp_path / "d.igps", ABOUT, "cosine", batches(rows))
    for one in (merged, whole, merge_indices(tmp_path / "a.igps", [tmp_path / "b.igps"])):
        found = one.search(rows[::100], cosine, top=4)
        expected = search(rows[::100], rows, top=4, distance=cosine)
        assert names(one, found.indices) == [[str(i) for i in row] for row in expected.indices.tolist()]


def test_a_changed_entry_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    rows = units(1400)
    write_index(tmp_path / "g.igps", ABOUT, "cosine", batches(rows[:1200]))
    again = extend_index(tmp_path / "g.igps", ABOUT, batches(rows[:100]))
    assert len(again) == 1200
    assert len(again.parts) == 1
    changed = extend_index(tmp_path / "g.igps", ABOUT, batches(rows[1200:1300], mark="b"))
    assert len(changed) == 1200
    now = torch.cat([rows[1200:1300], rows[100:1200]])
    found = changed.search(now[::60], cosine, top=3)
    expected = search(now[::60], now, top=3, distance=cosine)
    assert names(changed, found.indices) == [[str(i) for i in row] for row in expected.indices.tolist()]
    assert changed.marks(["5", "500", "9999"]) == {"5": "b", "500": "a"}
    # Most of a part gone: it is written anew.
    assert sum(map(len, extend_index(tmp_path / "g.igps", ABOUT, batches(rows[200:], 200, "c")).parts)) < 1500


def test_entries_that_were_replaced_do_not_count_as_many(tmp_path: Path) -> None:
    """Fewer than 1,024 have no short vectors; those that a newer entry has replaced are not there any more."""
    rows = units(1300)
    write_index(tmp_path / "g.igps", ABOUT, "cosine", batches(rows[:900]))
    changed = extend_index(tmp_path / "g.igps", ABOUT, batches(rows[900:1200], mark="b"))
    assert len(changed) == 900
    assert changed.vector_map is None
    assert extend_index(tmp_path / "g.igps", ABOUT, batches(rows[:200], first=900)).vector_map is not None


def test_descriptions_of_one_size_and_two_shapes_are_refused(tmp_path: Path) -> None:
    both = [*batches(units(10)), *batches(units(10).reshape(10, 4, 4), first=10)]
    with pytest.raises(ValueError, match=r"expected shape \(16,\) as before, got \(4, 4\)"):
        write_index(tmp_path / "g.igps", ABOUT, "cosine", both)
    assert not (tmp_path / "g.igps" / "manifest.json").exists()


@pytest.mark.skipif(os.name == "nt", reason="Windows opens no folders")
def test_files_and_their_folder_are_written_to_the_disk_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "part").write_text("part")
    synced = []
    monkeypatch.setattr(os, "fsync", lambda handle: synced.append(os.fstat(handle).st_ino))
    index_part.flush(tmp_path)
    assert sorted(synced) == sorted(path.stat().st_ino for path in (tmp_path, tmp_path / "part"))


def test_an_index_of_something_else_is_refused(tmp_path: Path) -> None:
    write_index(tmp_path / "g.igps", ABOUT, "cosine", batches(units(10)))
    other = {"descriptor": "test", "signature": {"resolution": 20}}
    with pytest.raises(ValueError, match=r"g\.igps: the index is of another signature.resolution: it has 32, not 20"):
        extend_index(tmp_path / "g.igps", other, batches(units(10)))
    write_index(tmp_path / "h.igps", {**ABOUT, "descriptor": "rich"}, "cosine", batches(units(10)))
    with pytest.raises(ValueError, match=r'h\.igps: .* another descriptor: it has "rich", not "test"'):
        merge_indices(tmp_path / "i.igps", [tmp_path / "g.igps", tmp_path / "h.igps"])
    with pytest.raises(ValueError, match=r"queries: expected descriptions of shape \(16,\)"):
        VectorIndex(tmp_path / "g.igps").search(units(1, 5), cosine, top=1)
    with pytest.raises(ValueError, match="top: expected 1 to 10"):
        VectorIndex(tmp_path / "g.igps").search(units(1), cosine, top=11)
    with pytest.raises(ValueError, match="at least one to index"):
        write_index(tmp_path / "new.igps", ABOUT, "cosine", [])
    with pytest.raises(FileNotFoundError, match=r"nowhere: no index there"):
        VectorIndex(tmp_path / "nowhere")
    (tmp_path / "notes.txt").touch()
    with pytest.raises(ValueError, match=r"holds g.igps"):
        write_index(tmp_path, ABOUT, "cosine", batches(units(10)))
    assert len(VectorIndex(tmp_path / "g.igps")) == 10


@pytest.mark.parametrize("how", ["truncated", "gone", "empty"])
def test_every_damaged_file_is_told_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    monkeypatch.setattr(index_part, "_MOST_FLAT", 1000)
    index = write_index(tmp_path / "g.igps", ABOUT, "chi_square", batches(histograms(1100, 1100)))
    files = [path for path in index.path.rglob("*") if path.is_file() and path.name != "lock"]
    assert len(files) == 7
    for path in files:
        content = path.read_bytes()
        path.unlink()
        if how != "gone":
            path.write_bytes(content[: len(content) // 2 if how == "truncated" else 0])
        with pytest.raises((ValueError, FileNotFoundError), match=r"g\.igps") as raised:
            VectorIndex(index.path)
        assert "Build" in str(raised.value)
        assert "\n" not in str(raised.value)
        path.write_bytes(content)
        VectorIndex(index.path)


def test_parts_that_vanish_again_and_again_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each reading finds another manifest whose parts are gone: after some the index counts as damaged."""
    write_index(tmp_path / "g.igps", ABOUT, "cosine", batches(units(10)))
    manifest, n_read = index_module._manifest, iter(range(1000))

    def another(path: Path) -> dict[str, Any]:
        found = manifest(path)
        assert found is not None
        found["parts"][0]["folder"] = f"part-{next(n_read)}"
        return found

    monkeypatch.setattr(index_module, "_manifest", another)
    with pytest.raises(ValueError, match=r"g\.igps: the index is damaged"):
        VectorIndex(tmp_path / "g.igps")


def _answers(path: Path) -> list[list[str]]:
    index = VectorIndex(path)
    return names(index, index.search(units(1500)[::50], cosine, top=3).indices)


def test_several_processes_read_while_one_adds(tmp_path: Path) -> None:
    rows = units(1500)
    write_index(tmp_path / "g.igps", ABOUT, "cosine", batches(rows[:1300]))
    before = _answers(tmp_path / "g.igps")
    opened = VectorIndex(tmp_path / "g.igps")
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(_answers, tmp_path / "g.igps") for _ in range(8)]
        extend_index(tmp_path / "g.igps", ABOUT, batches(rows[1300:], 1300))
        after = _answers(tmp_path / "g.igps")
        assert all(future.result() in (before, after) for future in futures)
    # What was opened before stays what it was, though its files are replaced.
    assert names(opened, opened.search(rows[::50], cosine, top=3).indices) == before != after


_WRITER = """
import sys
sys.path[:0] = {path!r}
from test_index import ABOUT, batches, units
from igps.retrieval import index_part
from igps.retrieval.index import extend_index, write_index
index_part._MOST_FLAT = 1000
print("ready", flush=True)
sys.stdin.readline()
for number in range(1000):
    rows = units(1300, seed=number)
    write_index({folder!r}, ABOUT, "cosine", batches(rows[:1200], mark=str(number)))
    extend_index({folder!r}, ABOUT, batches(rows[1200:], 1200, str(number)))
"""


def killed_writers(folder: Path, n_kills: int, longest: float = 0.25) -> int:
    """Kill a process so many times while it builds an index and adds to it; how often it was neither before nor after.

    After each the index must hold one build or one build and its addition, whole.
    """
    wrong = 0
    words = _WRITER.format(path=[str(Path(__file__).parent)], folder=str(folder))
    generator = random.Random(0)
    for _ in range(n_kills):
        child = subprocess.Popen([sys.executable, "-c", words], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert child.stdin is not None
        assert child.stdout is not None
        child.stdout.readline()
        child.stdin.write(b"go\n")
        child.stdin.flush()
        time.sleep(generator.uniform(0, longest))
        os.kill(child.pid, signal.SIGKILL)
        child.communicate()
        if not (folder / "manifest.json").exists():
            continue
        index = VectorIndex(folder)
        number = index.entries([0])[0].mark
        rows = units(1300, seed=int(number))
        everything = torch.cat([descriptions for _, descriptions in index.batches()])
        entries = [entry for positions, _ in index.batches() for entry in index.entries(positions)]
        whole = len(index) in (1200, 1300) and torch.equal(everything, rows[: len(index)])
        marked = [(entry.id, entry.mark) for entry in entries] == [(str(i), number) for i in range(len(index))]
        found = index.search(rows[:20], cosine, top=1).indices[:, 0]
        wrong += not (whole and marked and found.tolist() == list(range(20)))
    return wrong


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL")
def test_a_kill_leaves_the_last_good_state(tmp_path: Path) -> None:
    folder = tmp_path / "g.igps"
    assert killed_writers(folder, 3) == 0
    # And the next writer removes what they left.
    write_index(folder, ABOUT, "cosine", batches(units(50)))
    assert json.loads((folder / "manifest.json").read_text())["parts"][0]["n"] == 50
    left = {path.name.partition("-")[0] for path in folder.iterdir()}
    assert left == {"manifest.json", "lock", "part"}
    assert len(list(folder.iterdir())) == 3


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs a system that tells the memory of files")
def test_what_was_read_of_a_part_can_be_given_back(tmp_path: Path) -> None:
    """Otherwise an index of a million would fill the memory of who builds it with its files."""

    def of_files() -> float:
        (found,) = re.findall(r"RssFile:\s+(\d+) kB", Path("/proc/self/status").read_text())
        return int(found) / 1024

    generator = np.random.default_rng(0)
    for n_cells, kept in ((500, 4), (1500, 2)):  # the longer in half precision
        writer = index_part.PartWriter(tmp_path / str(n_cells), n_cells)
        values = generator.standard_normal((10_000, n_cells)).astype(np.float32)
        writer.append(values, [Entry(str(i), str(i)) for i in range(len(values))])
        writer.finish()
        part = index_part.Part(tmp_path / str(n_cells), len(values), n_cells)
        before, size = of_files(), values.size * kept / 2**20
        found = np.concatenate([part.descriptions(rows) for rows in part.chunks()])
        read = of_files()
        part.forget()
        assert read > before + 0.8 * size
        assert of_files() < read - 0.8 * size
        np.testing.assert_allclose(found, values, rtol=1e-3, atol=1e-3)
        np.testing.assert_array_equal(part.descriptions(np.arange(7)), found[:7])
