"""The page of results in a headless Chromium: it is opened, clicked, searched, turned and printed."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from pages import (
    DESCRIPTORS,
    EVIL,
    LABELS,
    NAMES,
    NOTE,
    answers_folder,
    comparison_folder,
    distances_of,
    retrieval_folder,
    surfaces,
    worst_by_a_loop,
)
from trimesh.creation import icosphere

from commands import run
from conftest import as_mesh
from igps.analysis.clusters import clusters_of
from igps.analysis.map import body_map
from igps.report.page import render_page
from igps.report.pictures import surface_of
from igps.report.results import Results, System, read_results
from igps.shapes import ArticulatedShapes
from igps.signature.signature import SignatureConfig, compute_signature

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed: it drives the browser"
)

# Software renders in place of a graphics card; in containers root must go without the sandbox.
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE = 60_000  # milliseconds


@pytest.fixture(scope="module")
def browser():
    path = (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
    if path is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    flags = [*FLAGS, "--no-sandbox"] if os.geteuid() == 0 else FLAGS
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=path, args=flags, timeout=PATIENCE)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A page of each kind of results."""
    body = icosphere(subdivisions=3)
    body.vertices *= [
        1.0,
        0.6 + 0.3 * (body.vertices[:, 2] > 0).mean(),
        2.2,
    ]
    mesh = as_mesh(body)
    root = tmp_path_factory.mktemp("pages")
    pictures = surfaces(mesh)
    made = {
        "retrieve": retrieval_folder(root / "retrieve"),
        "compare": comparison_folder(root / "compare"),
        "unlabelled": retrieval_folder(root / "unlabelled", labels=()),
        "answers": answers_folder(root / "answers"),
    }
    for name, results in made.items():
        page = render_page(read_results(results), pictures)
        (root / f"{name}.html").write_text(page, encoding="utf-8")
    return root


class Visit:
    """A page in the browser, and what went wrong or over the network."""

    def __init__(self, browser, path, **options):
        self.context = browser.new_context(
            **{"viewport": {"width": 1200, "height": 900}, **options}
        )
        self.context.set_default_timeout(PATIENCE)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on(
            "console", lambda message: self.complaints.append(f"{message.type}: {message.text}")
        )
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.address = path.as_uri()
        self.page.goto(self.address)

    def __enter__(self):
        return self

    def __exit__(self, *failure):
        self.context.close()
        if failure[0] is None:
            assert self.complaints == []
            assert {url for url in self.requests if not url.startswith("data:")} == {self.address}

    def wait_until(self, is_so):
        """The page's policy forbids the waiting of Playwright's own, which evaluates text in the page."""
        end = time.monotonic() + PATIENCE / 1000
        while not is_so():
            assert time.monotonic() < end
            self.page.wait_for_timeout(50)

    def name(self):
        """Of the shape that is open."""
        return str(self.page.locator("#shape-name").inner_text())

    def shown(self):
        """Names on the wall that the search lets through."""
        return list(self.page.locator("#shapes .shape:visible .name").all_inner_texts())

    def open(self, shape):
        self.page.locator(f'#shapes .shape[data-shape="{shape}"]').click()
        dialog = self.page.locator("dialog[open]")
        dialog.wait_for()
        return dialog


@pytest.fixture
def retrieval(browser, folder):
    with Visit(browser, folder / "retrieve.html") as visit:
        yield visit


@pytest.mark.parametrize("kind", ["retrieve", "compare", "unlabelled", "answers"])
def test_every_kind_opens_without_complaint_or_request(browser, folder, kind):
    with Visit(browser, folder / f"{kind}.html") as visit:
        assert len(visit.shown()) == len(NAMES)
        visit.open(1).locator("#close").click()
        visit.page.locator("dialog[open]").wait_for(state="detached")


def test_bodies_of_one_file_are_shown_together_with_part_unit_and_volume(browser, tmp_path):
    names = ("1.nii#liver", "1.nii#spleen", "2.nii#liver")
    np.savez(
        tmp_path / "distances.npz",
        distances=1 - np.eye(3),
        names=names,
        labels=("liver", "spleen", "liver"),
    )
    files = [{"file": name, "part": name[6:]} for name in names]
    (tmp_path / "meshes.json").write_text(json.dumps({"meshes": files}))
    body = as_mesh(icosphere(subdivisions=2)).annotated(unit="mm")
    one = next(iter(surfaces(body).values()))
    page = render_page(read_results(tmp_path), dict.fromkeys(names, one))
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    with Visit(browser, tmp_path / "page.html") as visit:
        dialog = visit.open(1)
        facts = dialog.locator("#facts").inner_text()
        assert "spleen" in facts
        assert f"{body.area:.4g} mm², {body.volume:.4g} mm³" in facts
        assert dialog.locator("#together-list .name").all_inner_texts() == [names[0]]
        dialog.locator("#together-list .shape").click()
        visit.wait_until(lambda: visit.name() == names[0])
        dialog.locator("#close").click()
        assert visit.open(2).locator("#together").is_hidden()


@pytest.fixture
def answers(browser, folder):
    with Visit(browser, folder / "answers.html") as visit:
        yield visit


def places_on_the_map(visit):
    """(N, 2) centres of the points on the screen."""
    visit.page.locator("#map-plot").scroll_into_view_if_needed()
    boxes = [visit.page.locator(f'[data-point="{i}"]').bounding_box() for i in range(len(NAMES))]
    return np.array(
        [
            [
                box["x"] + box["width"] / 2,
                box["y"] + box["height"] / 2,
            ]
            for box in boxes
        ]
    )


def selected(visit):
    return {
        int(one.get_attribute("data-point"))
        for one in visit.page.locator('[data-point][aria-selected="true"]').all()
    }


def test_the_map_has_the_places_of_the_distances_and_tells_the_one_under_the_mouse(answers):
    places = places_on_the_map(answers)
    points = body_map(distances_of(0)).points
    scale = np.ptp(places[:, 0]) / np.ptp(points[:, 0])
    assert np.diff(places[:, 0]) == pytest.approx(scale * np.diff(points[:, 0]), abs=1)
    found = np.diff(places[:, 1])
    expected = pytest.approx(
        -scale * np.diff(points[:, 1]),
        abs=1,
    )
    assert found == expected
    answers.page.mouse.move(*places[1])
    tip = answers.page.locator("#map-tip")
    tip.wait_for()
    assert NAMES[1] in tip.inner_text()
    answers.wait_until(lambda: tip.locator("canvas.drawn").count() == 1)
    answers.page.mouse.move(5, 5)
    tip.wait_for(state="hidden")
    answers.page.mouse.click(*places[1])
    answers.wait_until(lambda: answers.page.locator("dialog[open]").count() == 1)
    assert answers.name() == NAMES[1]


def test_a_brush_selects_what_lies_in_it(answers):
    places = places_on_the_map(answers)
    order = places[:, 0].argsort()
    middle = (places[order[2], 0] + places[order[3], 0]) / 2
    mouse = answers.page.mouse
    low = places.min(axis=0) - 6
    high = places.max(axis=0) + 6
    mouse.move(*low)
    mouse.down()
    mouse.move(middle, high[1], steps=4)
    mouse.up()
    assert selected(answers) == set(order[:3].tolist())
    assert answers.page.locator("#map-chosen").inner_text() == "3 selected"
    shown = answers.page.locator("#map-selected .name").all_inner_texts()
    assert sorted(shown) == sorted(NAMES[i] for i in order[:3])
    answers.page.keyboard.down("Shift")
    mouse.move(places[order[-1], 0] - 3, low[1])
    mouse.down()
    mouse.move(*high, steps=4)
    mouse.up()
    answers.page.keyboard.up("Shift")
    assert selected(answers) >= {*order[:3].tolist(), int(order[-1])}
    mouse.click(*low)
    assert selected(answers) == set()


def test_the_map_is_walked_through_by_the_keyboard(answers):
    page = answers.page
    places = places_on_the_map(answers)
    assert page.locator('[data-point][tabindex="0"]').count() == 1
    page.locator('[data-point="0"]').focus()
    assert NAMES[0] in page.locator("#map-tip").inner_text()

    def here():
        return int(page.evaluate("document.activeElement.dataset.point"))

    walked = {here()}
    for key, axis, sign in 2 * (
        ("ArrowRight", 0, 1),
        ("ArrowDown", 1, 1),
        ("ArrowLeft", 0, -1),
        ("ArrowUp", 1, -1),
    ):
        while True:
            before = here()
            page.keyboard.press(key)
            if here() == before:
                break
            assert sign * (places[here(), axis] - places[before, axis]) > 0
            walked.add(here())
    assert len(walked) > 2
    last = here()
    page.keyboard.press("Space")
    assert selected(answers) == {last}
    page.keyboard.press("Escape")
    assert selected(answers) == set()
    page.keyboard.press("Enter")
    answers.wait_until(lambda: page.locator("dialog[open]").count() == 1)
    assert answers.name() == NAMES[last]
    page.keyboard.press("Escape")
    answers.wait_until(lambda: page.locator("dialog[open]").count() == 0)
    assert here() == last


def test_the_tree_joins_what_is_near_and_selects_what_lies_under_a_branch(answers):
    page = answers.page
    distances = np.asarray(distances_of(0), dtype=float)
    distances = (distances + distances.T) / 2
    groups = {frozenset([i]) for i in range(len(NAMES))}
    expected = []
    while len(groups) > 1:  # by hand: the two groups that are nearest in the mean
        apart = {
            pair: distances[np.ix_(*map(sorted, pair))].mean()
            for pair in itertools.combinations(groups, 2)
        }
        one, other = min(apart, key=lambda pair: apart[pair])
        groups = groups - {one, other} | {one | other}
        expected.append((one | other, apart[one, other]))
    page.locator("#tree-plot").scroll_into_view_if_needed()
    stability = clusters_of(distances, n_resamples=50).stability
    told = (
        f"{np.count_nonzero(np.array(stability) >= 0.75)} of {len(stability)} clusters are stable."
    )
    assert page.locator("#tree-summary").inner_text() == told
    branches = page.locator("#tree-plot .branch").all()[::-1]
    assert len(branches) == len(expected)
    for branch, (members, distance) in zip(branches, expected, strict=True):
        branch.focus()
        page.keyboard.press("Enter")
        assert selected(answers) == members
        assert branch.get_attribute("aria-selected") == "true"
        assert f"distance {distance:.3g}" in str(branch.get_attribute("aria-label"))
        faint = {
            int(one.get_attribute("data-leaf")) for one in page.locator("#tree-plot .faint").all()
        }
        assert faint == set(range(len(NAMES))) - members
    lowest, (pair, _) = branches[0], expected[0]
    box = lowest.bounding_box()
    page.mouse.click(
        box["x"] + box["width"] / 2,
        box["y"] + box["height"] / 2,
    )
    assert selected(answers) == pair
    walked = [lowest.get_attribute("aria-label")]
    while page.evaluate("document.activeElement.getAttribute('aria-label')") != branches[
        -1
    ].get_attribute("aria-label"):
        page.keyboard.press("ArrowUp")
        walked.append(page.evaluate("document.activeElement.getAttribute('aria-label')"))
    assert walked == [
        one.get_attribute("aria-label")
        for one, (members, _) in zip(branches, expected, strict=True)
        if members >= pair
    ]
    page.keyboard.press("Escape")
    assert selected(answers) == set()


def test_leaves_of_the_tree_have_the_colours_of_the_map(answers):
    for colour in ("class", "cluster", "column dose"):
        answers.page.locator("#map-colour").select_option(colour)
        for i in range(len(NAMES)):
            point, leaf = (
                answers.page.locator(f'[data-{kind}="{i}"]') for kind in ("point", "leaf")
            )
            filled = [
                one.evaluate("(mark) => getComputedStyle(mark).fill") for one in (point, leaf)
            ]
            assert filled[0] == filled[1] != "rgb(0, 0, 0)"


@pytest.mark.parametrize(
    ("colour", "legend"),
    [
        ("class", [f"{EVIL} 3", "alone 1", "egg 3"]),
        ("column age", ["50 1", "51 1", "52 1", "53 1", "54 1", "55 1", "unknown 1"]),
        (f"column {EVIL}", ["x 4", "y 3"]),
        ("cluster", None),
    ],
)
def test_the_map_is_coloured(answers, colour, legend):
    answers.page.locator("#map-colour").select_option(colour)
    entries = [
        " ".join(one.split()) for one in answers.page.locator("#map-legend li").all_inner_texts()
    ]
    if legend is None:
        found = clusters_of(distances_of(0), n_resamples=50)
        legend = [
            f"cluster {i + 1}"
            + f", stability {one:.2f}" * bool(np.isfinite(one))
            + f" {(found.labels == i).sum()}"
            for i, one in enumerate(found.stability)
        ]
    assert entries == legend
    assert answers.page.evaluate("window.ran") is None
    marks = {
        (mark.get_attribute("class"), mark.get_attribute("d"))
        for mark in answers.page.locator("[data-point]").all()
    }
    assert len(marks) == len(legend)


def test_numbers_have_a_scale_of_colours(answers):
    answers.page.locator("#map-colour").select_option("column dose")
    assert answers.page.locator("#map-legend li").inner_text().split() == ["0.5", "6.5"]
    colours = [
        answers.page.locator(f'[data-point="{i}"]').evaluate("mark => getComputedStyle(mark).fill")
        for i in range(len(NAMES))
    ]
    assert colours[0] == "rgb(72, 40, 120)"
    assert colours[-1] == "rgb(253, 231, 37)"
    assert len(set(colours)) == len(NAMES)


def test_groups_and_outliers_of_the_same_folder_are_told(answers):
    groups = [
        row.inner_text().split("\t") for row in answers.page.locator("#groups tbody tr").all()
    ]
    assert groups[0] == [
        EVIL,
        "0.0010",
        "0.0020",
        "0.0100",
        "0.0200",
        "0.250",
        "0.125 to 0.375",
        "0.88",
        "a:8 b:9",
    ]
    assert groups[1] == ["liver", "not tested: a has 3.", "a:3 b:9"]
    outliers = answers.page.locator("#outliers tbody tr")
    assert outliers.all_inner_texts()[1].split("\t") == [
        "gone.off",
        "1.0",
        "egg",
        "nothing unusual",
    ]
    assert outliers.locator("a").count() == 1
    outliers.locator("a").click()
    answers.wait_until(lambda: answers.page.locator("dialog[open]").count() == 1)
    assert answers.name() == NAMES[5]


def test_names_run_nothing(retrieval):
    page = retrieval.page
    assert page.evaluate("window.ran") is None
    assert EVIL in page.locator("#shapes h3").all_inner_texts()[0]
    retrieval.open(1)
    assert page.locator("#shape-name").inner_text() == NAMES[1]
    assert page.evaluate("window.ran") is None
    assert page.locator("main img, main b").count() == 0


def test_no_other_script_could_run(browser, folder):
    with Visit(browser, folder / "retrieve.html") as visit:
        visit.page.evaluate(
            "() => { const s = document.createElement('script'); s.text = 'window.ran = 3'; "
            "document.body.append(s); }"
        )
        assert visit.page.evaluate("window.ran") is None
        assert "Content Security Policy" in visit.complaints.pop()


def test_pictures_are_drawn(retrieval):
    page = retrieval.page
    retrieval.wait_until(lambda: page.locator("#shapes canvas.drawn").count() == len(NAMES) - 1)
    pixels = page.evaluate(
        "() => { const c = document.querySelector('#shapes canvas.drawn');"
        "return [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data]; }"
    )
    pixels = np.array(pixels).reshape(-1, 4)
    inside = pixels[:, 3] > 200
    assert 0.1 < inside.mean() < 0.8  # a body on a clear ground
    assert np.ptp(pixels[inside, 0].astype(int)) > 60  # violet in the middle, yellow at the ends
    assert not page.locator(f'#shapes .shape[data-shape="{len(NAMES) - 2}"] canvas.drawn').count()


def test_a_click_shows_the_ranking(retrieval):
    query = 3
    distances = distances_of(0)
    dialog = retrieval.open(query)
    order = sorted(
        (j for j in range(len(NAMES)) if j != query),
        key=lambda j: distances[query, j],
    )
    cards = dialog.locator("#ranking-list .shape")
    assert cards.locator(".name").all_inner_texts() == [NAMES[j] for j in order]
    for place, j in enumerate(order):
        told = cards.nth(place).inner_text()
        assert str(place + 1) in told
        assert f"{distances[query, j]:.3g}"[:4] in told
        right = LABELS[j] == LABELS[query]
        words = ("✓", "same class") if right else ("✗", "another class")
        unwanted = ("✗", "another class") if right else ("✓", "same class")
        for word in words:
            assert word in told
        for word in unwanted:
            assert word not in told
        border = cards.nth(place).evaluate("button => getComputedStyle(button).borderStyle")
        assert border == ("solid" if right else "dashed")
    cards.nth(0).click()
    retrieval.wait_until(lambda: retrieval.name() == NAMES[order[0]])
    retrieval.page.go_back()
    retrieval.wait_until(lambda: retrieval.name() == NAMES[query])
    retrieval.page.go_back()
    retrieval.page.locator("dialog[open]").wait_for(state="detached")


def test_marks_on_the_wall_tell_the_nearest(retrieval):
    distances = distances_of(0) + np.diag([np.inf] * len(NAMES))
    for i, name in enumerate(NAMES):
        told = retrieval.page.locator(f'#shapes .shape[data-shape="{i}"]').inner_text()
        right = LABELS[distances[i].argmin()] == LABELS[i]
        alone = LABELS.count(LABELS[i]) == 1
        assert ("✓" in told, "✗" in told) == (right and not alone, not right and not alone), name


def test_repairs_are_told(retrieval):
    assert NOTE in retrieval.open(2).locator("#facts").inner_text()
    retrieval.page.locator("#close").click()
    assert NOTE in retrieval.page.locator("#repaired").inner_text()
    retrieval.page.locator("#repaired a").click()
    retrieval.wait_until(lambda: retrieval.name() == NAMES[2])
    retrieval.page.locator("#close").click()
    assert "no repair was needed" in retrieval.open(0).locator("#facts").inner_text()


def test_search_and_filter(retrieval):
    page = retrieval.page
    page.locator("#search").fill("EGG c.off")
    assert retrieval.shown() == [NAMES[2]]
    assert page.locator("#shown").inner_text() == f"1 of {len(NAMES)} shapes"
    assert page.locator("#shapes .class:visible").count() == 1
    page.locator("#search").fill("holes")  # a repair
    assert retrieval.shown() == [NAMES[2]]
    page.locator("#search").fill("no such shape")
    assert page.locator("#nothing").is_visible()
    page.locator("#search").fill("")
    assert sorted(retrieval.shown()) == sorted(NAMES)
    page.locator("#only").select_option("repaired")
    assert retrieval.shown() == [NAMES[2]]
    page.locator("#only").select_option("missed")
    missed = retrieval.shown()
    page.locator("#only").select_option("found")
    assert sorted([*missed, *retrieval.shown(), NAMES[-1]]) == sorted(NAMES)


def test_a_body_turns(retrieval):
    dialog = retrieval.open(0)
    page = retrieval.page
    canvas = dialog.locator("#turntable")
    canvas.wait_for()
    before = canvas.screenshot()
    box = canvas.bounding_box()
    assert box is not None
    x = box["x"] + box["width"] / 2
    y = box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 120, y + 40, steps=4)
    page.mouse.up()
    dragged = canvas.screenshot()
    assert dragged != before
    canvas.focus()
    focused = canvas.screenshot()
    page.keyboard.press("ArrowLeft")
    assert canvas.screenshot() != focused
    assert (
        page.locator("#shape-name").inner_text() == NAMES[0]
    )  # the arrow turned the body and led nowhere
    page.keyboard.press("Home")
    page.locator("#close").focus()
    assert canvas.screenshot() == before
    page.locator("#close").press("ArrowRight")
    retrieval.wait_until(lambda: retrieval.name() == NAMES[1])


def test_a_shape_without_picture_says_so(retrieval):
    dialog = retrieval.open(len(NAMES) - 2)
    assert dialog.locator("#turntable").is_hidden()
    assert "no picture" in dialog.locator("#turntable-hint").inner_text()


def test_all_by_keyboard(retrieval):
    page = retrieval.page
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.dataset.shape") is not None:
            break
    opened = page.evaluate("document.activeElement.dataset.shape")
    page.keyboard.press("Enter")
    page.locator("dialog[open]").wait_for()
    assert page.evaluate("document.activeElement.id") == "shape-name"
    page.keyboard.press("Escape")
    page.locator("dialog[open]").wait_for(state="detached")
    retrieval.wait_until(lambda: page.evaluate("document.activeElement.dataset.shape") == opened)
    retrieval.wait_until(lambda: page.evaluate("location.hash") == "")


def test_a_shape_that_is_chosen_while_another_closes_is_opened(retrieval):
    """The browser tells of the closing late, after the next shape was chosen."""
    page = retrieval.page
    for query, following in ((0, 3), (3, 1)):
        retrieval.open(query)
        page.evaluate(f"() => {{ document.getElementById('shape').close(); goTo({following}); }}")
        retrieval.wait_until(partial(lambda name: retrieval.name() == name, NAMES[following]))
        page.wait_for_timeout(300)
        assert page.locator("dialog[open]").count() == 1
        assert page.evaluate("location.hash") == f"#shape-{following}"
        page.locator("#close").click()
        retrieval.wait_until(lambda: page.evaluate("location.hash") == "")


def test_a_link_leads_to_a_shape(browser, folder):
    with Visit(browser, folder / "retrieve.html") as visit:
        visit.page.goto(f"{visit.address}#shape-4")
        visit.page.reload()
        visit.page.locator("dialog[open]").wait_for()
        assert visit.page.locator("#shape-name").inner_text() == NAMES[4]
        visit.requests = [url.partition("#")[0] for url in visit.requests]


def test_another_descriptor_ranks_otherwise(browser, folder):
    with Visit(browser, folder / "compare.html") as visit:
        page = visit.page
        query = 0
        found = {}
        for seed, name in enumerate(DESCRIPTORS):
            page.locator("#system").select_option(str(seed))
            assert name in page.locator("#confusion-heading").inner_text()
            distances = distances_of(seed)[: len(NAMES) - seed, : len(NAMES) - seed]
            dialog = visit.open(query)
            found[name] = dialog.locator("#ranking-list .name").all_inner_texts()
            order = sorted(
                range(1, len(distances)),
                key=lambda j: distances[query, j],
            )
            assert found[name] == [NAMES[j] for j in order]
            page.locator("#close").click()
        assert found["interior"] != found["gps"]
        assert "could not describe" in visit.open(len(NAMES) - 1).inner_text()
        page.locator("#close").click()
        assert page.locator("#precision-recall .legend li").all_inner_texts() == list(DESCRIPTORS)


def test_the_worst_confusions_follow_the_descriptor(browser, folder):
    with Visit(browser, folder / "compare.html") as visit:
        page = visit.page
        for seed, name in enumerate(DESCRIPTORS):
            page.locator("#system").select_option(str(seed))
            assert page.locator("#worst-heading").inner_text() == f"Worst confusions, {name}"
            n = len(NAMES) - seed
            distances = distances_of(seed)[:n, :n]
            expected = worst_by_a_loop(distances, LABELS[:n], NAMES[:n])
            assert expected
            rows = page.locator("#worst-list > li")
            assert rows.count() == len(expected)
            for row, one in zip(rows.all(), expected, strict=True):
                query = one["query"]
                order = sorted(
                    (j for j in range(n) if j != query), key=lambda j: distances[query, j]
                )
                wrong = [order[rank - 1] for rank in one["wrong"]]
                assert row.locator(".name").all_inner_texts() == [NAMES[j] for j in (query, *wrong)]
                assert row.locator(".name + .about").all_inner_texts() == [
                    LABELS[j] for j in (query, *wrong)
                ]
                ranks = [text.split()[-1] for text in row.locator(".rank").all_inner_texts()]
                assert ranks == [str(rank) for rank in one["wrong"]]
                marks = [text.split() for text in row.locator(".mark").all_inner_texts()]
                assert marks == [["✗", "another", "class"]] * len(wrong)
                n_right = LABELS[:n].count(LABELS[query]) - 1
                tier = sum(LABELS[j] == LABELS[query] for j in order[:n_right]) / n_right
                told = f"First of the same class at rank {one['rank']} of {n - 1}. First tier: {100 * tier:.1f} %."
                assert row.locator("p").inner_text() == told


def test_a_worst_confusion_opens_its_rankings(retrieval):
    """By click and by key; whoever closes the window is where they were, not on the wall."""
    page = retrieval.page
    expected = worst_by_a_loop(distances_of(0), LABELS, NAMES)[0]
    pictures = page.locator("#worst-list > li").first.locator(".shape")
    pictures.first.click()
    retrieval.wait_until(lambda: retrieval.name() == NAMES[expected["query"]])
    ranked = page.locator("#ranking-list .shape .name")
    wrong = ranked.nth(expected["wrong"][0] - 1).inner_text()
    assert pictures.nth(1).locator(".name").inner_text() == wrong
    page.keyboard.press("Escape")
    page.locator("dialog[open]").wait_for(state="detached")
    retrieval.wait_until(lambda: page.evaluate("location.hash") == "")
    assert pictures.first.evaluate("button => button === document.activeElement")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    retrieval.wait_until(lambda: retrieval.name() == wrong)
    ranked.first.click()  # and on to another ranking within the window
    retrieval.wait_until(lambda: retrieval.name() != wrong)
    page.locator("#close").click()
    retrieval.wait_until(
        lambda: pictures.nth(1).evaluate("button => button === document.activeElement")
    )
    opened = retrieval.open(0)  # the wall has its own way back
    opened.locator("#close").click()
    retrieval.wait_until(
        lambda: page.evaluate(
            "document.activeElement === document.querySelector('#shapes [data-shape=\"0\"]')"
        )
    )


def test_without_confusions_the_page_says_so(browser, tmp_path):
    """All right by the first descriptor, and the second describes one shape of each class."""
    results = comparison_folder(tmp_path / "compare")
    right = np.array([[float(one != other) for other in LABELS] for one in LABELS])
    for name, some in zip(
        DESCRIPTORS,
        (list(range(len(NAMES))), [0, 3]),
        strict=True,
    ):
        np.savez_compressed(
            results / "distances" / f"{name}.npz",
            distances=right[np.ix_(some, some)],
            names=np.array(NAMES)[some],
            labels=np.array(LABELS)[some],
        )
    (tmp_path / "right.html").write_text(render_page(read_results(results), {}), encoding="utf-8")
    with Visit(browser, tmp_path / "right.html") as visit:
        worst = visit.page.locator("#worst")
        assert "There are no confusions" in worst.inner_text()
        assert worst.locator("#worst-list").is_hidden()
        visit.page.locator("#system").select_option("1")
        assert "gps describes no two shapes of one class" in worst.inner_text()
        assert worst.locator("#worst-list").is_hidden()


def test_confusion_and_sorted_scores(retrieval):
    page = retrieval.page
    rows = page.locator("#confusion-table tbody tr")
    assert rows.count() == 3
    before = rows.all_inner_texts()
    page.locator("#confusion-of").select_option("tier")
    assert rows.all_inner_texts() != before
    table = page.locator("#class-scores")
    names = table.locator("tbody th").all_inner_texts()
    assert names == sorted(set(LABELS))
    table.locator("thead button", has_text="class").click()
    assert table.locator("tbody th").all_inner_texts() == names[::-1]
    table.locator("thead button", has_text="FT").click()
    values = [
        text for text in table.locator("tbody td:nth-child(4)").all_inner_texts() if text != "–"
    ]
    assert [float(value) for value in values] == sorted(map(float, values))
    assert table.locator("thead th[aria-sort=ascending]").inner_text().startswith("FT")


def test_light_and_dark(browser, folder):
    def background(visit):
        colour = visit.page.evaluate("getComputedStyle(document.body).backgroundColor")
        return np.mean([float(part) for part in colour.strip("rgb()").split(",")])

    with Visit(browser, folder / "retrieve.html", color_scheme="dark") as visit:
        assert background(visit) < 60
        visit.page.locator("#theme").click()
        assert background(visit) > 200
        visit.page.locator("#theme").click()
        assert background(visit) < 60
    with Visit(browser, folder / "retrieve.html", color_scheme="light") as visit:
        assert background(visit) > 200


def test_a_narrow_window_holds_all(browser, folder):
    with Visit(browser, folder / "compare.html", viewport={"width": 360, "height": 700}) as visit:
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= 360
        dialog = visit.open(0)
        assert dialog.evaluate("dialog => dialog.scrollWidth <= dialog.clientWidth")


def test_print_has_all_pictures_and_no_controls(retrieval):
    page = retrieval.page
    page.set_viewport_size({"width": 1200, "height": 120})  # most shapes are out of sight
    content = page.pdf()
    assert content.startswith(b"%PDF")
    assert page.locator("#shapes canvas.drawn").count() == len(NAMES) - 1
    worst = page.locator(f'#worst-list canvas:not([data-shape="{len(NAMES) - 2}"])')
    assert worst.count() > 0
    assert page.locator("#worst-list canvas.drawn").count() == worst.count()
    page.emulate_media(media="print")
    assert page.locator("nav").is_hidden()
    assert page.locator("#search").is_hidden()
    assert page.locator("#confusion-table").is_visible()
    page.emulate_media(media="screen")
    page.set_viewport_size({"width": 1200, "height": 900})
    retrieval.open(0)
    page.emulate_media(media="print")
    assert page.locator("main").is_hidden()
    assert page.locator("#facts").is_visible()


@pytest.fixture
def violations():
    """What axe-core finds wrong with a page."""
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason="axe-playwright-python is not installed"
    )
    return lambda page: list(axe.Axe().run(page).response["violations"])


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("kind", ["retrieve", "compare", "unlabelled", "answers"])
def test_nothing_serious_for_accessibility(browser, folder, violations, scheme, kind):
    with Visit(browser, folder / f"{kind}.html", color_scheme=scheme) as visit:

        def serious():
            return [
                f"{one['id']}: {node['html']}: {node['failureSummary']}"
                for one in violations(visit.page)
                for node in one["nodes"]
                if one["impact"] in ("serious", "critical")
            ]

        for details in visit.page.locator("details").all():
            details.evaluate("details => { details.open = true; }")
        assert serious() == []
        visit.open(1)
        assert serious() == []
        visit.page.set_viewport_size({"width": 400, "height": 700})
        assert serious() == []


def test_the_checker_would_see_a_fault(retrieval, violations):
    retrieval.page.locator("#theme").evaluate(
        "button => { button.removeAttribute('aria-label'); button.textContent = ''; }"
    )
    assert "button-name" in {one["id"] for one in violations(retrieval.page)}


def test_the_demo_ends_with_its_page(browser, tmp_path, monkeypatch, capsys):
    """A smaller demo, the last line of which names a page that opens."""
    few = ArticulatedShapes(n_classes=2, n_per_class=2)
    monkeypatch.setattr("igps.shapes.ArticulatedShapes", lambda **_: few)
    run("demo", "--out", tmp_path, "--n_workers", 1)
    *_, last = capsys.readouterr().out.splitlines()
    path = Path(last.removeprefix("page of results: "))
    assert path == tmp_path / "report.html"
    with Visit(browser, path) as visit:
        assert visit.page.locator("h1").inner_text() == "4 shapes in 2 classes, pretrained"
        visit.wait_until(lambda: visit.page.locator("#shapes canvas.drawn").count() == 4)
        assert visit.open(0).locator("#ranking-list .shape").count() == 3


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """A page of two organs of three scans in the frame of the patient, with a column of labels.csv."""
    body = icosphere(subdivisions=3)
    mesh = as_mesh(body).annotated(frame="RAS", unit="mm")
    signature = compute_signature(mesh, SignatureConfig(n_eigenpairs=8, resolution=6))
    names = tuple(f"cohort_{i:02}.nii.gz#{part}" for part in ("1", "2") for i in range(3))
    distances = torch.from_numpy(distances_of(0)[:6, :6])
    labels = ("one", "one", "one", "two", "two", "two")
    results = Results(
        "retrieve",
        names,
        labels,
        (System("interior", names, labels, distances),),
        parts={name: name[-1] for name in names},
        columns={"scanner": dict(zip(names, "xyxxyx", strict=True))},
    )
    path = tmp_path_factory.mktemp("scans") / "page.html"
    page = render_page(results, dict.fromkeys(names, surface_of(mesh, signature, 300)))
    path.write_text(page, encoding="utf-8")
    return path


def test_columns_of_a_table_are_told_and_filter(browser, scans):
    with Visit(browser, scans) as visit:
        visit.page.locator("select.filter").select_option("=y")
        assert visit.shown() == ["cohort_01.nii.gz#1", "cohort_01.nii.gz#2"]
        dialog = visit.open(1)
        facts = dialog.locator("#facts > div").all_text_contents()
        assert "scannery" in facts


def test_bodies_of_one_file_are_laid_together(browser, scans):
    with Visit(browser, scans) as visit:
        order = visit.page.locator("#order")
        order.select_option("file")
        headings = visit.page.locator("#shapes .class:visible h3").all_inner_texts()
        assert headings == [f"cohort_0{i}.nii.gz" for i in range(3)]
        assert visit.shown()[:2] == ["cohort_00.nii.gz#1", "cohort_00.nii.gz#2"]
        order.select_option("class")
        assert visit.shown()[:2] == ["cohort_00.nii.gz#1", "cohort_01.nii.gz#1"]


def test_long_names_are_shown_whole(browser, scans):
    with Visit(browser, scans) as visit:
        shape = visit.page.locator("#shapes .shape").first
        name = shape.locator(".name")
        assert name.inner_text() == shape.get_attribute("title")
        assert name.evaluate("e => e.scrollWidth <= e.clientWidth")
        assert name.evaluate("e => e.scrollHeight <= e.clientHeight")


def test_letters_of_the_patient_follow_the_turns(browser, scans):
    """From the front, the patient's right is on the left; the right arrow key brings the side that was on the right."""
    with Visit(browser, scans) as visit:
        dialog = visit.open(0)
        letters = dialog.locator("#turntable-sides span")
        assert letters.all_inner_texts() == ["R", "L", "I", "S"]
        dialog.locator("#turntable").focus()
        for _ in range(9):
            visit.page.keyboard.press("ArrowRight")
        visit.wait_until(lambda: letters.all_inner_texts() == ["A", "P", "I", "S"])
