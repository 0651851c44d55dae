from __future__ import annotations

import base64
import json
import os
import re
from html.parser import HTMLParser
from importlib.resources import files

import numpy as np
import pytest
import torch
from pages import (
    EVIL,
    LABELS,
    NAMES,
    NOTE,
    comparison_folder,
    distances_of,
    retrieval_folder,
    surfaces,
)

from igps.report.page import render_page
from igps.report.page_data import data_of
from igps.report.results import read_results
from igps.retrieval import precision_recall_curve, retrieval_scores


class Elements(HTMLParser):
    """What a browser would make of the page: its elements and its text outside of scripts."""

    def __init__(self, page):
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.scripts: list[str] = []
        self.inside = ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self.inside = tag

    def handle_endtag(self, tag):
        self.inside = ""

    def handle_data(self, data):
        (self.scripts if self.inside in ("script", "style") else self.texts).append(data)

    @property
    def text(self):
        return re.sub(r"\s+", " ", " ".join(self.texts))

    def data(self):
        return json.loads(
            next(script for script in self.scripts if script.startswith('{"classes"'))
        )


@pytest.fixture
def page(tmp_path, blob):
    """A page of a labelled collection, with pictures."""
    return render_page(read_results(retrieval_folder(tmp_path)), surfaces(blob))


def test_no_script_or_style_closes_its_own_element():
    """They are written into the page as they are."""
    sources = [
        one
        for one in (files("igps.report") / "template").iterdir()
        if one.name.endswith((".js", ".css"))
    ]
    assert len(sources) >= 7
    for source in sources:
        assert not re.search(r"</(script|style)", source.read_text("utf-8"), re.IGNORECASE), source


def test_rankings_and_scores_are_those_of_a_loop(tmp_path):
    data = data_of(read_results(retrieval_folder(tmp_path)), {})
    assert data["classes"] == sorted(set(LABELS))
    (system,) = data["systems"]
    distances = distances_of(0)
    n = len(NAMES)
    assert system["shapes"] == list(range(n))
    assert system["top"] == n - 1
    ranked = np.frombuffer(base64.b64decode(system["ranked"]), "<u4").reshape(
        n,
        n - 1,
    )
    told = np.frombuffer(base64.b64decode(system["distances"]), "<f4").reshape(
        n,
        n - 1,
    )
    nearest, tier = np.zeros((2, 3, 3), dtype=int)
    for i in range(n):
        order = sorted(
            (j for j in range(n) if j != i),
            key=lambda j: distances[i, j],
        )
        assert ranked[i].tolist() == order
        np.testing.assert_array_equal(told[i], distances[i, order])
        of = data["classes"].index
        nearest[of(LABELS[i]), of(LABELS[order[0]])] += 1
        for j in order[: LABELS.count(LABELS[i]) - 1]:
            tier[of(LABELS[i]), of(LABELS[j])] += 1
    assert system["confusion"] == {"nearest": nearest.tolist(), "tier": tier.tolist()}
    assert nearest.sum() == n
    scores = retrieval_scores(torch.from_numpy(distances), LABELS)
    assert system["scores"] == pytest.approx(scores.mean(), abs=1e-5)
    alone = data["classes"].index("alone")
    egg = data["classes"].index("egg")
    assert system["per_class"][alone] is None
    assert system["per_class"][egg]["ft"] == pytest.approx(
        scores.per_class()["egg"]["ft"], abs=1e-5
    )
    assert system["per_query"]["nn"][-1] is None  # it has no other of its class
    assert system["per_query"]["nn"][:-1] == scores.nn[:-1].tolist()
    curve = precision_recall_curve(torch.from_numpy(distances), LABELS)
    assert system["curve"][1] == pytest.approx(curve.precision.tolist(), abs=1e-5)


def test_names_from_files_are_harmless_everywhere(page):
    seen = Elements(page)
    tags = {tag for tag, _ in seen.elements}
    assert not {"img", "b", "i", "iframe"} & tags
    assert (
        sum(tag == "script" for tag, _ in seen.elements) == 8
    )  # numbers, surfaces, three.js, and five of ours
    for _, attributes in seen.elements:
        for name in attributes:
            assert not name.startswith("on")
    # A name may stand in two elements, of which the first is cut where there is no room.
    text = "".join(seen.text.split())
    for told in (*NAMES, EVIL, NOTE, "bad<b>.off: it is open."):
        assert "".join(told.split()) in text
    assert "49/c.off" not in page
    assert [shape["name"] for shape in seen.data()["shapes"]] == list(NAMES)
    assert seen.data()["classes"] == sorted(set(LABELS))


def test_nothing_is_loaded(page):
    seen = Elements(page)
    links = [
        attributes.get(name)
        for _, attributes in seen.elements
        for name in ("src", "href", "action", "data")
    ]
    assert {link for link in links if link} <= {"data:,"} | {
        link for link in links if link and link[0] == "#"
    }
    policy = (
        next(attributes["content"] for _, attributes in seen.elements if "http-equiv" in attributes)
        or ""
    )
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    targets = {link[1:] for link in links if link and link[0] == "#"}
    assert {target for target in targets if not target.startswith("shape-")} <= {
        a.get("id") for _, a in seen.elements
    }


def test_surfaces_lie_in_the_order_of_the_shapes(tmp_path, blob):
    pictures = surfaces(blob)
    seen = Elements(render_page(read_results(retrieval_folder(tmp_path)), pictures))
    lines = next(script for script in seen.scripts if script.startswith("\n")).strip().split("\n")
    assert len(lines) == len(NAMES) - 1
    for name, shape in zip(NAMES, seen.data()["shapes"], strict=True):
        assert ("surface" in shape) == (name in pictures)
        if name in pictures:
            place, n_vertices, n_faces = shape["surface"]
            content = base64.b64decode(lines[place])
            assert content == pictures[name].packed()
            assert len(content) == 7 * n_vertices + 6 * n_faces


def test_without_classes_only_rankings(tmp_path):
    results = read_results(retrieval_folder(tmp_path, labels=()))
    seen = Elements(render_page(results, {}))
    (system,) = seen.data()["systems"]
    assert seen.data()["classes"] == []
    assert [system[name] for name in ("scores", "curve", "confusion", "per_query", "worst")] == [
        None
    ] * 5
    ids = {attributes.get("id") for _, attributes in seen.elements}
    assert {"shapes", "unused", "repaired"} <= ids
    assert not {"scores", "confusion", "precision-recall", "worst"} & ids
    assert sum(attributes.get("class") == "shape" for _, attributes in seen.elements) == len(NAMES)


@pytest.mark.parametrize("kind", ["classes of one", "one class", "several"])
def test_scores_and_confusions_need_classes(tmp_path, kind):
    labels = {"classes of one": NAMES, "one class": ("egg",) * len(NAMES), "several": LABELS}[kind]
    results = read_results(retrieval_folder(tmp_path, labels=labels))
    ids = {attributes.get("id") for _, attributes in Elements(render_page(results, {})).elements}
    assert ("scores" in ids) == (kind != "classes of one")
    assert ("worst" in ids) == (kind == "several")


def test_classes_of_two_have_the_scores_of_a_single_answer(tmp_path):
    labels = ("egg", "egg", "cup", "cup", "ant", "ant", "alone")
    results = read_results(retrieval_folder(tmp_path, labels=labels))
    seen = Elements(render_page(results, {}))
    (system,) = seen.data()["systems"]
    distances = distances_of(0)
    ranks = []
    for i in range(6):
        order = sorted(
            (j for j in range(7) if j != i),
            key=lambda j: (distances[i, j], j),
        )
        ranks.append(1 + order.index(i ^ 1))
    assert system["per_query"]["rank"] == [*ranks, None]
    assert system["scores"]["nn"] == pytest.approx(
        np.mean(np.equal(ranks, 1)),
        abs=1e-5,
    )
    assert system["scores"]["median_rank"] == np.sort(ranks)[2]
    assert system["curve"] is system["per_class"] is None
    titles = [attributes.get("title", "") for tag, attributes in seen.elements if tag == "abbr"]
    assert any("among the nearest 5" in title for title in titles)
    assert not any("E-measure" in title or "discounted" in title for title in titles)
    assert not {"class-scores", "precision-recall"} & {a.get("id") for _, a in seen.elements}


def test_a_comparison_has_all_descriptors(tmp_path):
    seen = Elements(render_page(read_results(comparison_folder(tmp_path / "compare")), {}))
    systems = seen.data()["systems"]
    assert [system["name"] for system in systems] == ["interior", "gps"]
    assert [len(system["shapes"]) for system in systems] == [len(NAMES), len(NAMES) - 1]
    assert sum(tag == "option" and a.get("value") in ("0", "1") for tag, a in seen.elements) == 2
    assert "gps it has no surface." in seen.text
    assert "all it is open." in seen.text
    assert "7 shapes in 3 classes, 2 descriptors" in seen.text


def test_of_several_results_the_last_are_shown(tmp_path):
    retrieval_folder(tmp_path / "both")
    folder = tmp_path / "both"
    rows = [{"descriptor": "gps", "n_models": 0, "seconds_per_mesh": None}]
    (folder / "compare.json").write_text(json.dumps(rows))
    os.utime(folder / "compare.json", (1, 1))
    assert read_results(folder).command == "retrieve"
    os.utime(folder / "distances.npz", (0, 0))
    (folder / "failures.csv").unlink()
    assert read_results(folder).command == "compare"


def test_what_is_no_folder_of_results_is_told(tmp_path):
    with pytest.raises(FileNotFoundError, match="no results found"):
        read_results(tmp_path)
    retrieval_folder(tmp_path)
    np.savez(
        tmp_path / "distances.npz", distances=np.zeros((2, 2)), names=np.array(["a", "b", "c"])
    )
    with pytest.raises(
        ValueError, match=r"expected distances and labels \(or no labels\) of 3 meshes"
    ):
        read_results(tmp_path)
