"""The tables of the pages are those of the files of results, and these are of today's signatures."""

import json

import pytest
from docs.benchmarks import tables

from igps.signature.signature import SignatureConfig

PAGES = {page.name: page.read_text("utf-8") for page in tables.PAGES.glob("*.md")}
SHOWN = [(page, name) for page, text in sorted(PAGES.items()) for name in tables.table_names(text)]


@pytest.mark.parametrize(("page", "name"), SHOWN)
def test_a_table_is_of_the_signatures_of_today(page, name):
    version = tables.load_results(name)["signatures"]
    assert version == SignatureConfig.ALGORITHM_VERSION, f"{page}: measure {name} again"


@pytest.mark.parametrize(
    "page",
    sorted({page for page, _ in SHOWN}),
)
def test_a_page_shows_what_was_measured(page):
    remedy = "write it by python -m docs.benchmarks.tables"
    assert tables.with_tables(PAGES[page]) == PAGES[page], remedy


def test_every_result_is_shown():
    assert {path.stem for path in tables.RESULTS.glob("*.json")} == {name for _, name in SHOWN}


def test_results_become_a_table_of_a_page(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "PAGES", tmp_path)
    monkeypatch.setattr(tables, "RESULTS", tmp_path / "results")
    page = tmp_path / "page.md"
    page.write_text("# Title\n\n<!-- results: mine -->\nold\n<!-- end of results -->\n\nrest\n")
    row = {"descriptor": "d2", "nn": 0.5, "ft": 0.25, "st": 1, "dcg": 0, "adr_self": 0.1234}
    row |= {"map": None, "seconds_per_mesh": 0.042}
    (tmp_path / "compare.json").write_text(json.dumps([row]))
    tables.record("mine", "scores", tmp_path, "igps compare ROOT")
    lines = page.read_text("utf-8").splitlines()
    assert "| descriptor | NN | FT | ST | DCG | ADR self | mAP | s/body |" in lines
    assert "| `d2` | 50.0 | 25.0 | 100.0 | 0.0 | 12.3 | – | 0.04 |" in lines
    assert any(line.startswith("`igps compare ROOT`: version ") for line in lines)
    assert lines[0] == "# Title"
    assert lines[-1] == "rest"
    assert "old" not in lines
    with pytest.raises(ValueError, match="kind: expected one of scores"):
        tables.record("mine", "other", tmp_path, "x")
