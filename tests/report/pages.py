"""Folders of results for the tests of their page, with names that would be markup if they were not escaped."""

import csv
import json
from fractions import Fraction

import numpy as np

from igps.report.pictures import surface_of
from igps.signature.signature import SignatureConfig, compute_signature

EVIL = "<script>window.ran = 1</script>"
LABELS = ("egg", "egg", "egg", EVIL, EVIL, EVIL, "alone")
NAMES = (
    "egg/a.off",
    "egg/<img src=x onerror='window.ran=2'>.off",
    "egg/c.off",
    f"{EVIL}/a.off",
    '"></script><b>/b.off',
    "{{ 7 * 7 }}/c.off",
    "alone/a.off",
)
NOTE = "3 holes of <i>which</i> & two were filled"
DESCRIPTORS = ("interior", "gps")


def distances_of(seed):
    """Symmetric, classes mostly together."""
    rng = np.random.default_rng(seed)
    centres = {label: rng.uniform(0, 1.5, 3) for label in dict.fromkeys(LABELS)}
    points = np.array([centres[label] for label in LABELS]) + rng.normal(0, 0.4, (len(LABELS), 3))
    return np.linalg.norm(points[:, None] - points[None], axis=2).astype(np.float32)


def worst_by_a_loop(distances, labels, names):
    """The worst confusions from their definition: each query is looked at alone, walking down its ranking."""
    found = []
    for query, label in enumerate(labels):
        others = sorted(
            (j for j in range(len(labels)) if j != query), key=lambda j: (distances[query][j], j)
        )
        n_right = sum(labels[j] == label for j in others)
        if n_right == 0:
            continue
        rank = 1
        while labels[others[rank - 1]] != label:
            rank += 1
        tier = Fraction(sum(labels[j] == label for j in others[:n_right]), n_right)
        if tier == 1:
            continue
        before = range(1, rank) if rank > 1 else range(1, n_right + 1)
        wrong = [place for place in before if labels[others[place - 1]] != label]
        found.append(
            (
                (-rank, tier, names[query]),
                {
                    "query": query,
                    "rank": rank,
                    "wrong": wrong[:3],
                },
            )
        )
    return [one for _, one in sorted(found, key=lambda pair: pair[0])][:20]


def write_rows(path, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def retrieval_folder(folder, labels=LABELS, seed=0):
    """What `igps retrieve` writes."""
    folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        folder / "distances.npz",
        distances=distances_of(seed),
        names=np.array(NAMES),
        labels=np.array(labels),
    )
    config = {"descriptor": "interior", "n_eigenpairs": 20, "attributes": [], "max_vertices": None}
    (folder / "scores.json").write_text(json.dumps({"config": config}))
    write_rows(
        folder / "failures.csv", [("name", "error"), ("bad<b>.off", "bad<b>.off: it is open.")]
    )
    write_rows(folder / "notes.csv", [("name", "note"), (NAMES[2], NOTE)])
    return folder


def answers_folder(folder):
    """What `igps retrieve`, `groups` and `outliers` write, with columns of labels.csv."""
    retrieval_folder(folder)
    bodies = [{"file": name} for name in NAMES]
    columns = {
        "age": [str(50 + i) for i in range(len(NAMES) - 1)] + [None],
        EVIL: ["x", "y"] * 3 + ["x"],
    }
    columns["dose"] = [str(i + 0.5) for i in range(len(NAMES))]
    (folder / "meshes.json").write_text(json.dumps({"meshes": bodies, "columns": columns}))
    tested = {
        "permanova_p": 0.001,
        "permanova_q": 0.002,
        "kernel_p": 0.01,
        "kernel_q": 0.02,
        "effect": 0.25,
    }
    tested |= {"effect_low": 0.125, "effect_high": 0.375, "auc": 0.875, "refused": None}
    groups = [
        {"body": EVIL, "sizes": "a:8 b:9", **tested},
        {"body": "liver", "sizes": "a:3 b:9", **dict.fromkeys(tested), "refused": "a has 3."},
    ]
    (folder / "groups.json").write_text(json.dumps(groups))
    outliers = [
        {
            "name": NAMES[5],
            "class": EVIL,
            "score": 7.25,
            "reason": "its shape is <b>unlike</b> its class",
        },
        {"name": "gone.off", "class": "egg", "score": 1.0, "reason": "nothing unusual"},
    ]
    (folder / "outliers.json").write_text(json.dumps(outliers))
    return folder


def comparison_folder(folder):
    """What `igps compare` writes; the second descriptor does not describe the last mesh."""
    (folder / "distances").mkdir(parents=True)
    rows = []
    for seed, name in enumerate(DESCRIPTORS):
        n = len(NAMES) - seed
        arrays = {
            "distances": distances_of(seed)[:n, :n],
            "names": np.array(NAMES[:n]),
            "labels": np.array(LABELS[:n]),
        }
        np.savez_compressed(folder / "distances" / f"{name}.npz", **arrays)
        rows.append({"descriptor": name, "n_models": n, "seconds_per_mesh": 0.25})
    rows.append({"descriptor": "broken", "n_models": 0, "seconds_per_mesh": None})
    (folder / "compare.json").write_text(json.dumps(rows))
    failed = [("gps", NAMES[-1], "it has no surface."), ("all", "bad.off", "it is open.")]
    write_rows(folder / "failures.csv", [("descriptor", "name", "error"), *failed])
    write_rows(folder / "notes.csv", [("name", "note"), (NAMES[2], NOTE)])
    return folder


def surfaces(mesh):
    """The mesh as a picture for all but the last but one of the names."""
    config = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=200)
    one = surface_of(mesh, compute_signature(mesh, config), 300)
    return {name: one for name in NAMES if name != NAMES[-2]}
