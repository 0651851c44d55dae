"""Two processes write to a gallery and are killed at random times; it holds all finished changes, no partial one."""

import os
import pickle
import signal
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from numpy.random import default_rng
from outcome import Row

import igps.gallery.gallery  # before the forks; this does not import LanceDB, whose threads do not survive a fork
from igps.gallery.about import about_of
from igps.mesh.options import LoadOptions
from igps.retrieval import cosine
from igps.signature.signature import SignatureConfig

SEED = 14
WIDTH, N_UNCHANGED, N_IDS = 24, 400, 300
# Longest time from the first change of a writer to its kill, seconds
_MAX_DELAY = 0.8
_TIMEOUT = 120.0

Rows = dict[str, tuple[float, int]]
"""Volume, and seed of the vector, by id."""


def vector(seed):
    values = default_rng(seed).standard_normal(WIDTH, dtype=np.float32)
    return values / np.linalg.norm(values)


def change(writer, number):
    """A change by a writer: its kind, the chosen ids, and a value."""
    generator = default_rng([SEED, writer, number])
    chosen = generator.choice(N_IDS, int(generator.integers(1, 60)), replace=False).tolist()
    return str(generator.choice(["add", "add", "remove", "update"])), chosen, number


def changed(rows, writer, number):
    """The rows of a writer after a change."""
    kind, chosen, value = change(writer, number)
    ids = [f"{writer}/{i}" for i in chosen]
    if kind == "add":
        seeds = (1000 * (2 * value + writer) + i for i in chosen)  # no two vectors are equal
        return {**rows, **{id_: (0.0, seed) for id_, seed in zip(ids, seeds, strict=True)}}
    if kind == "remove":
        return {id_: row for id_, row in rows.items() if id_ not in ids}
    return {id_: (float(value), row[1]) if id_ in ids else row for id_, row in rows.items()}


def _tables():
    """Import the module of tables, and with it LanceDB, in a child process, with lower limits to build indices."""
    torch.set_num_threads(1)
    from igps.gallery import table

    for name, value in {"_MIN_ROWS_FOR_INDEX": N_UNCHANGED // 2, "_INDEX_INTERVAL": 8}.items():
        assert hasattr(table, name)
        setattr(table, name, value)
    return table


def _vectors_and_rows(rows):
    vectors = torch.from_numpy(np.stack([vector(seed) for _, seed in rows.values()]))
    return vectors, [
        {"id": id_, "name": id_, "volume": volume} for id_, (volume, _) in rows.items()
    ]


def _create(path):
    about = about_of(SignatureConfig(), LoadOptions(), "interior")
    unchanged = {f"unchanged/{i}": (1.0, 10**9 + i) for i in range(N_UNCHANGED)}
    _tables().write(path, about, "cosine", [_vectors_and_rows(unchanged)], {})


def _write(path, writer, number, journal):
    """Make changes until the process is killed, and write the number of each finished change to the journal."""
    _tables()
    gallery = igps.gallery.gallery.Gallery(path)
    with journal.open("a", buffering=1) as file:
        while True:
            kind, chosen, value = change(writer, number)
            where = "id IN ({})".format(", ".join(f"'{writer}/{i}'" for i in chosen))
            if kind == "add":
                gallery.table.add(*_vectors_and_rows(changed({}, writer, number)), {})
            elif kind == "remove":
                gallery.remove(where)
            else:
                with gallery.table.changing(where) as table:
                    table.update(where=where, values={"volume": float(value)})
            file.write(f"{number}\n")
            number += 1


def _read(path, out):
    """Write all rows of the table to a file, and whether some of them are found as nearest to themselves."""
    table = _tables().BodyTable(path)
    rows = {
        row["id"]: (row["volume"], vectors)
        for batch in table.batches()
        for vectors, row in zip(*table.decoded(batch), strict=True)
    }
    ids = sorted(rows)[:: max(len(rows) // 10, 1)]
    are_nearest = all(
        table.nearest(rows[id_][1][None], cosine, top=1)[0][0]["id"] == id_ for id_ in ids
    )
    arrays = {id_: (volume, values.numpy()) for id_, (volume, values) in rows.items()}
    out.write_bytes(pickle.dumps((arrays, are_nearest)))


def _fork(function, *arguments):
    """Call a function in a fork of this process, and return the id of the fork."""
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            function(*arguments)
            status = 0
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            os._exit(status)
    return pid


def _succeeds(pid):
    """Wait for the end of a process, and return whether its exit status is 0."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


class _Round:
    """Two writers that change one gallery until they are killed.

    Args:
        folder: of the gallery and the journals.
        number: of the round, from 1.
        numbers: of each writer, how many changes it finished in earlier rounds.
    """

    def __init__(self, folder, number, numbers):
        self.number = number
        self.missed = list[str]()
        self.n_killed = 0
        self._gallery = folder / "gallery.igps"
        self._out = folder / "rows"
        self._journals = [folder / f"{number}-{writer}" for writer in range(2)]
        self._writers = [
            _fork(_write, self._gallery, i, numbers[i], self._journals[i]) for i in range(2)
        ]

    def wait(self):
        """Wait until both writers have finished a change."""
        start = time.monotonic()
        while not all(path.exists() and path.stat().st_size for path in self._journals):
            if time.monotonic() - start > _TIMEOUT:
                self.miss("a writer waits for ever")
                return
            time.sleep(0.005)

    def kill(self, generator):
        """Kill one writer after the other, at random moments."""
        for writer in generator.permutation(2):
            time.sleep(generator.uniform(0, _MAX_DELAY / 2))
            process = self._writers[writer]
            if os.waitpid(process, os.WNOHANG) == (0, 0):
                os.kill(process, signal.SIGKILL)
                os.waitpid(process, 0)
                self.n_killed += 1
            else:
                self.miss(f"writer {writer} ended by itself")

    def read(self):
        """Return the rows of the gallery, or None if it cannot be read."""
        if not _succeeds(_fork(_read, self._gallery, self._out)):
            self.miss("the gallery cannot be read")
            return None
        rows, are_nearest = pickle.loads(self._out.read_bytes())
        if not are_nearest:
            self.miss("a row is not the nearest to itself")
        return rows

    def n_finished(self, writer):
        """How many changes the writer finished in this round."""
        return len(self._journals[writer].read_text().splitlines())

    def miss(self, what):
        """Record a miss of the target."""
        self.missed.append(f"round {self.number}: {what}")


def _check_rows(played, actual, rows, numbers):
    """Compare the rows with the changes that were finished, bring `rows` and `numbers` up to date, and count them."""
    n_changes = 0
    for i in range(2):
        n_finished = played.n_finished(i)
        n_changes += n_finished
        for number in range(numbers[i], numbers[i] + n_finished):
            rows[i] = changed(rows[i], i, number)
        numbers[i] += n_finished
        own = {id_: row for id_, row in actual.items() if id_.startswith(f"{i}/")}
        if _equal(own, rows[i]):
            continue
        # The last change may be finished, but not yet in the journal.
        after = changed(rows[i], i, numbers[i])
        if _equal(own, after):
            rows[i] = after
            numbers[i] += 1
        else:
            played.miss(f"writer {i} had finished {numbers[i]} changes, the rows differ")
    unchanged = {f"unchanged/{i}": (1.0, 10**9 + i) for i in range(N_UNCHANGED)}
    untouched = {id_: row for id_, row in actual.items() if id_.startswith("u")}
    if not _equal(untouched, unchanged):
        played.miss("rows that nobody touched differ")
    return n_changes


def campaign(n_kills):
    """Kill both writers of a round, one after the other, while they add, remove and update rows."""
    start = time.monotonic()
    missed = list[str]()
    n_killed = 0
    n_changes = 0
    n_rounds = 0
    rows = [Rows(), Rows()]
    numbers = [0, 0]
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as name:
        folder = Path(name)
        if not _succeeds(_fork(_create, folder / "gallery.igps")):
            raise RuntimeError("the gallery could not be made")
        while n_killed < n_kills and not missed:
            generator = default_rng([SEED, n_rounds])
            n_rounds += 1
            played = _Round(folder, n_rounds, numbers)
            played.wait()
            played.kill(generator)
            actual = played.read()
            if actual is not None:
                n_changes += _check_rows(played, actual, rows, numbers)
            n_killed += played.n_killed
            missed += played.missed
    row = Row(
        "gallery",
        "kills of two that write to one gallery",
        n_killed,
        "it holds all finished changes, and none in part",
        f"{n_rounds} rounds, {n_changes} changes: {len(missed)} wrong",
        missed,
        seconds=time.monotonic() - start,
    )
    return [row]


def _equal(actual, expected):
    return actual.keys() == expected.keys() and all(
        actual[id_][0] == volume and np.allclose(actual[id_][1], vector(seed), atol=1e-6)
        for id_, (volume, seed) in expected.items()
    )
