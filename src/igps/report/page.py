"""The page of results: one HTML file that loads nothing, to look at rankings, scores and bodies."""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from igps.report.explanations import Painted
from igps.report.page_data import N_WORST, data_of, letters
from igps.report.results import Results
from igps.report.surfaces import PageSurface
from igps.report.tables import TITLES

_TEMPLATE = files("igps.report") / "template"
_SCRIPTS = ("three.min.js", "bodies.js", "tables.js", "map.js", "tree.js", "page.js")
N_OUTLIERS = 50
"""How many of the most unlike bodies the page lists."""
# Inside the axes of the plot of precision and recall, in units of its drawing.
_PLOT_WIDTH, _PLOT_HEIGHT = 600, 340

SCORE_MEANINGS = dict(  # noqa: C408
    nn="nearest neighbour: share of queries whose nearest shape is of their class",
    ft="first tier: share of the class among as many nearest shapes as it has other members",
    st="second tier: share of the class among twice as many",
    e="E-measure: harmonic mean of precision and recall in the first 32",
    dcg="discounted cumulative gain: hits count less the later they come",
    adr="average dynamic recall",
    adr_self="average dynamic recall with the query itself in the ranking, as in SHREC'07",
    map="mean average precision",
)
"""What the scores are, by name."""


def page_of(
    results: Results, surfaces: Mapping[str, PageSurface], explanations: Mapping[str, Painted] | None = None
) -> str:
    """The page of results as text, with surfaces by the name of the mesh, and explanations of those that have one."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    # Escapes all that it is given
    environment = Environment(
        loader=PackageLoader("igps.report", "template"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    data = data_of(results, surfaces, explanations)
    # A policy that names the page's own scripts and style by content: no other can run, wherever it came from.
    scripts = [(_TEMPLATE / name).read_text(encoding="utf-8").strip() + "\n" for name in _SCRIPTS]
    style = (_TEMPLATE / "page.css").read_text(encoding="utf-8")
    policy = (
        f"default-src 'none'; script-src {' '.join(map(_fingerprint, scripts))}; style-src {_fingerprint(style)}; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    classes, places = data["classes"], {name: i for i, name in enumerate(results.names)}
    members: list[list[int]] = [[] for _ in classes] or [[]]
    for i, shape in enumerate(data["shapes"]):
        members[shape["label"] if classes else 0].append(i)
    packed = [surfaces[name] for name in results.names if name in surfaces]
    return environment.get_template("page.html.j2").render(
        results=results,
        title=_title(results, data),
        data=data,
        members=members,
        surfaces=Markup("\n".join(letters(surface.packed()) for surface in packed)),
        scripts=[Markup(source) for source in scripts],
        style=Markup(style),
        policy=policy,
        licence=(_TEMPLATE / "three.LICENSE").read_text(encoding="utf-8"),
        titles=TITLES,
        meanings=SCORE_MEANINGS,
        curves=[_drawn(i, system) for i, system in enumerate(data["systems"]) if system["curve"]],
        n_worst=N_WORST,
        plot=(_PLOT_WIDTH, _PLOT_HEIGHT),
        config=_flat(results.config),
        disturbances=(results.robustness or {}).get("disturbances", {}),
        outliers=[{**one, "place": places.get(one["name"])} for one in results.outliers[:N_OUTLIERS]],
        n_repaired=sum(bool(shape["notes"]) for shape in data["shapes"]),
    )


def _fingerprint(source: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(source.encode()).digest()).decode()}'"


def _title(results: Results, data: Mapping[str, Any]) -> str:
    shapes = f"{len(results.names)} shape{'s' * (len(results.names) != 1)}"
    if data["classes"]:
        shapes += f" in {len(data['classes'])} class{'es' * (len(data['classes']) != 1)}"
    names = [system.name for system in results.systems] or list((results.robustness or {}).get("movements", {}))
    what = names[0] if len(names) == 1 else f"{len(names)} descriptors"
    return f"{shapes}, {what}" + (" under disturbance" if results.robustness else "")


def _drawn(i: int, system: Mapping[str, Any]) -> dict[str, Any]:
    """A curve of precision and recall as points of the drawing."""
    values = list(zip(*system["curve"], strict=True))
    points = [
        (round(recall * _PLOT_WIDTH, 1), round((1 - precision) * _PLOT_HEIGHT, 1)) for recall, precision in values
    ]
    path = "M" + " L".join(f"{x} {y}" for x, y in points)
    return {"style": i, "name": system["name"], "points": points, "path": path, "values": values}


def _flat(config: Mapping[str, Any]) -> Sequence[tuple[str, str]]:
    def told(value: Any) -> str:
        if isinstance(value, list | tuple):
            return ", ".join(map(str, value)) or "none"
        return "none" if value is None else str(value)

    return [(name.replace("_", " "), told(value)) for name, value in config.items()]
