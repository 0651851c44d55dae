"""The studies' results as tables of text, for a terminal."""

from __future__ import annotations

from collections.abc import Mapping

from training.studies.damage import DamageResult
from training.studies.damages import DAMAGES
from training.studies.disturbances import DISTURBANCES
from training.studies.robustness import POSE, Movement


def robustness_table(table: Mapping[str, Mapping[str, Movement]]) -> str:
    """The mean movements in percent, one line a descriptor and one column a disturbance, and what the columns mean."""
    columns = list(next(iter(table.values())))
    width = max(len(name) for name in table)
    lines = [" " * width + "".join(f"{column:>9}" for column in columns)]
    notes = []
    for name, movements in table.items():
        means = [movements[column].mean for column in columns]
        lines.append(f"{name:<{width}}" + "".join(f"{'-' if x is None else f'{100 * x:.1f}':>9}" for x in means))
        for column in columns:
            missing = movements[column].notes
            if missing:
                first = next(iter(missing.values()))
                n_all = len(movements[column].distances) + len(missing)
                notes.append(f"{name}, {column}: {len(missing)} of {n_all} missing; {first}")
    lines.append("mean movement in percent of the median distance between classes")
    lines += [f"  {column}: {DISTURBANCES[column].description}" for column in columns if column in DISTURBANCES]
    if POSE in columns:
        lines.append(f"  {POSE}: from one pose of a body to another, over all pairs")
    return "\n".join(lines + notes)


def damage_table(results: Mapping[str, Mapping[str, DamageResult]]) -> str:
    """One line a damage, of each descriptor the share of meshes described and the loss of NN and FT in points."""
    names = list(results)
    damages = list(next(iter(results.values())))
    width = max(len(name) for name in damages)
    lines = [" " * width + "".join(f"{name:>24}" for name in names)]
    lines.append(" " * width + "".join(f"{'used':>10}{'NN':>7}{'FT':>7}" for _ in names))
    notes = []
    for way in damages:
        found = [results[name][way] for name in names]
        cells = [f"{100 * one.usable:>9.0f}%{100 * one.loss('nn'):>7.1f}{100 * one.loss('ft'):>7.1f}" for one in found]
        lines.append(f"{way:<{width}}" + "".join(cells))
        for name, one in zip(names, found, strict=True):
            if one.notes:
                first = next(iter(one.notes.values()))
                notes.append(f"{name}, {way}: {len(one.notes)} of {one.n_given} missing; {first}")
    lines.append(
        "used: share of the damaged meshes that could be described; NN, FT: points lost against the clean twins"
    )
    lines += [f"  {way}: {DAMAGES[way].description}" for way in damages]
    return "\n".join(lines + notes)
