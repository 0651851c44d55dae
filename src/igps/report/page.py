"""The page of results: a self-contained HTML file that shows rankings, scores and bodies."""

import hashlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from igps._text import counted
from igps.report.page_data import N_WORST, base64_text, data_of
from igps.report.pictures import PageSurface
from igps.report.results import Results
from igps.report.tables import PAIR_TITLES, TITLES, score_cell

_TEMPLATE = files("igps.report") / "template"
_SCRIPTS = ("three.min.js", "bodies.js", "tables.js", "map.js", "tree.js", "page.js")
N_OUTLIERS = 50
"""Largest number of outliers on the page."""
_PLOT_WIDTH, _PLOT_HEIGHT = 600, 340  # of the axes of the precision–recall plot, in SVG units

SCORE_MEANINGS = {
    "nn": "nearest neighbour: share of queries whose nearest shape is of their class",
    "ft": "first tier: share of the query's class that is among the nearest n shapes, for a class with n other members",
    "st": "second tier: the same among the nearest 2n shapes",
    "e": "E-measure: harmonic mean of precision and recall among the nearest 32 shapes",
    "dcg": "discounted cumulative gain: shapes of the class count less the lower their rank",
    "adr": "average dynamic recall",
    "adr_self": "average dynamic recall with the query itself in the ranking, as in SHREC'07",
    "map": "mean average precision",
    "first_5": "share of queries whose other shape is among the nearest 5",
    "first_10": "share of queries whose other shape is among the nearest 10",
    "median_rank": "median rank of the other shape, from 1",
}
"""Explanations of the scores by name."""


def render_page(results: Results, surfaces: Mapping[str, PageSurface]) -> str:
    """Return the page of results as HTML text, with surfaces by the name of the mesh."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    # Autoescape, because names and notes come from files
    environment = Environment(
        loader=PackageLoader("igps.report", "template"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    data = data_of(results, surfaces)
    # The content security policy allows only the page's own scripts and style, identified by their hashes
    scripts = [(_TEMPLATE / name).read_text(encoding="utf-8").strip() + "\n" for name in _SCRIPTS]
    style = (_TEMPLATE / "page.css").read_text(encoding="utf-8")
    hashes = " ".join(map(_source_hash, scripts))
    policy = (
        f"default-src 'none'; script-src {hashes}; style-src {_source_hash(style)}; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    classes = data["classes"]
    members: list[list[int]] = [[] for _ in classes] or [[]]
    for i, shape in enumerate(data["shapes"]):
        group = shape["label"] if classes else 0
        members[group].append(i)
    packed = [base64_text(surfaces[name].packed()) for name in results.names if name in surfaces]
    indices = {name: i for i, name in enumerate(results.names)}
    outliers = []
    for row in results.outliers[:N_OUTLIERS]:
        outliers.append({**row, "place": indices.get(row["name"])})
    return environment.get_template("page.html.j2").render(
        results=results,
        title=_title(results, data),
        data=data,
        members=members,
        surfaces="\n".join(packed),
        scripts=scripts,
        style=style,
        policy=policy,
        licence=(_TEMPLATE / "three.LICENSE").read_text(encoding="utf-8"),
        titles=_titles(data),
        score_cell=score_cell,
        meanings=SCORE_MEANINGS,
        curves=[_curve(i, system) for i, system in enumerate(data["systems"]) if system["curve"]],
        n_worst=N_WORST,
        plot=(_PLOT_WIDTH, _PLOT_HEIGHT),
        config=_config_rows(results.config),
        outliers=outliers,
        n_repaired=sum(bool(shape["notes"]) for shape in data["shapes"]),
    )


def _source_hash(source: str) -> str:
    digest = hashlib.sha256(source.encode()).digest()
    return f"'sha256-{base64_text(digest)}'"


def _title(results: Results, data: Mapping[str, Any]) -> str:
    shapes = counted(len(results.names), "shape")
    n_classes = len(data["classes"])
    if n_classes:
        shapes += f" in {counted(n_classes, 'class')}"
    names = [system.name for system in results.systems]
    descriptors = names[0] if len(names) == 1 else f"{len(names)} descriptors"
    return f"{shapes}, {descriptors}"


def _titles(data: Mapping[str, Any]) -> dict[str, str]:
    """Return the column titles of the scores that the systems have, by name."""
    titles = TITLES | PAIR_TITLES
    known = {name for system in data["systems"] for name in system["scores"] or ()}
    return {name: titles[name] for name in titles if name in known}


def _curve(i: int, system: Mapping[str, Any]) -> dict[str, Any]:
    """Return the precision–recall curve of the i-th descriptor in SVG coordinates, with its style, name and values."""
    values = list(zip(*system["curve"], strict=True))
    points = []
    for recall, precision in values:
        x = round(recall * _PLOT_WIDTH, 1)
        y = round((1 - precision) * _PLOT_HEIGHT, 1)
        points.append((x, y))
    path = "M" + " L".join(f"{x} {y}" for x, y in points)
    return {
        "style": i,
        "name": system["name"],
        "points": points,
        "path": path,
        "values": values,
    }


def _config_rows(config: Mapping[str, Any]) -> Sequence[tuple[str, str]]:
    def as_text(value: Any) -> str:
        if isinstance(value, list | tuple):
            return ", ".join(map(str, value)) or "none"
        return "none" if value is None else str(value)

    return [(name.replace("_", " "), as_text(value)) for name, value in config.items()]
