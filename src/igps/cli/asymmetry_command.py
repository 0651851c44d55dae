"""The command `igps asymmetry`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps._parameters import check_at_least

if TYPE_CHECKING:
    from igps.analysis.asymmetry import Pair
    from igps.data.sources import Bodies


def asymmetry(
    root: Path,
    descriptor: str = "pretrained",
    top: int = 20,
    out: Path | None = None,
    **reading: Any,
) -> list[dict[str, Any]]:
    """Compare left with right: for each subject and paired structure, how far both differ, and whether that is unusual.

    Structures are paired by their names, such as kidney_left and kidney_right, or Left-Hippocampus and
    Right-Hippocampus. Form is the distance of the left one and the mirrored right one, without size; size is the
    difference of the volumes over their mean. Scores count robust standard deviations from the other subjects, of whom
    there must be four. Pairs with a structure at the border of the image have none.

    Args:
        root: folder with a file of labels, or a folder of masks, for each subject; or with folders left and right.
        top: number of pairs to list.
        out: folder for asymmetry.csv and asymmetry.json with all pairs.
    """
    import numpy as np

    from igps.analysis.asymmetry import MIN_SUBJECTS, asymmetries, find_pairs
    from igps.cli.reading import Folder, described
    from igps.fields.volumes.border import border_of
    from igps.report.figures import write_analysis
    from igps.report.tables import text_table

    check_at_least(0, top=top)

    def paired(bodies: Bodies) -> list[Pair]:
        pairs = find_pairs(bodies)
        if not pairs:
            raise ValueError(
                f"{root}: no body has a partner on the other side by its name, as kidney_left has in kidney_right. "
                "Name labels by --names."
            )
        return pairs

    result = described(
        Folder(root, check=paired), descriptor, size="ignore", mirror="same", **reading
    )
    dataset = result.dataset
    names = dataset.bodies.names
    pairs = paired(dataset.bodies)  # without the bodies that could not be used
    volumes = np.array([signature.volume for signature in dataset.signatures()])
    borders = [border_of(notes) for notes in dataset.all_notes()]
    is_cut = [border is not None for border in borders]
    found = asymmetries(pairs, result.descriptor, result.descriptions, volumes, is_cut)
    rows = []
    for one in found:
        at_border = [borders[i] for i in (one.pair.left, one.pair.right)]
        rows.append(
            {
                "subject": one.pair.subject,
                "structure": one.pair.structure,
                "form": one.form,
                "size": one.size,
                "form_score": one.form_score,
                "size_score": one.size_score,
                "left": names[one.pair.left],
                "right": names[one.pair.right],
                "border_sides": " ".join(border.sides for border in at_border if border) or None,
            }
        )
    cells = []
    for row in rows[:top]:
        form_score, size_score = (
            "–" if row[name] is None else f"{row[name]:.1f}"
            for name in ("form_score", "size_score")
        )
        pair = f"{row['subject']} {row['structure']}"
        cut = f"at the border: {row['border_sides']}" if row["border_sides"] else ""
        cells.append(
            (f"{row['form']:.3g}", form_score, f"{row['size']:+.1%}", size_score, pair, cut)
        )
    titles = ("form", "score", "size", "score", "pair", "")
    print(text_table(titles, cells, left=("pair", "")))
    if all(one.score is None for one in found):
        print(f"no scores: fewer than {MIN_SUBJECTS} subjects have the same whole pair")
    if out is not None:
        write_analysis(out, "asymmetry", rows)
        print(f"written to {out}")
    return rows
