"""The commands `igps fit` and `igps classify`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from igps.data.dataset import Failure
    from igps.nn.descriptor import Descriptor


_TITLES = {
    "nn": "NN",
    "ft": "FT",
    "dcg": "DCG",
    "accuracy": "classified correctly",
    "balanced_accuracy": "classified correctly, mean over the classes",
    "auc": "area under the curve, each class against the others",
    "calibration_error": "expected calibration error",
    "unknown_auc": "recognising a class that was left out as unknown, AUC",
}
# With fewer, the interval of a share is wider than 17 % even if all are right, and none of them is among the strangest
# 5 % on which the limit of unlike bodies stands.
_N_BODIES = 20


def fit(
    root: Path,
    out: Path,
    descriptor: str = "pretrained",
    goal: Literal["known", "new"] = "known",
    head: Literal["auto", "classifier", "linear", "whitened", "as_is"] = "auto",
    no_prior: bool = False,
    n_workers: int | None = None,
    strict: bool = False,
    **reading: Any,
) -> dict[str, Any]:
    """Fit a metric or a classifier to a labelled folder, for igps classify and for --descriptor of other commands.

    A model card in Markdown, with scores on held-out bodies, is written beside the model file, or into the model's
    folder.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        out: file for the model, ending in .safetensors, or a folder to share.
        descriptor: a name, as in igps help descriptors, a file, or package.module:NAME of your own descriptor.
        goal: known to recognise the classes of the folder; new for a metric that also serves other classes.
        head: classifier, linear (also of plain numbers and size), whitened, or as_is for the descriptor itself; auto
            takes the best on held-out bodies.
        no_prior: ignore the descriptor's own metric, and fit to its histograms alone
    """
    from igps._progress import number_bars
    from igps.cli.reading import Folder, print_failures, signatures
    from igps.descriptors import descriptor as descriptor_of
    from igps.descriptors.measures import Measures
    from igps.learning.fitting import check_classes
    from igps.learning.fitting import fit as fit_head
    from igps.nn.description import check_centres
    from igps.nn.specification import IN_FOLDER, specification

    file = next(out.iterdir(), None) if out.is_dir() else None
    if file is not None and not (out / IN_FOLDER).is_file():
        raise ValueError(
            f"out: expected a new or empty folder, or a model's, {out} holds {file.name}. Choose another."
        )
    base = descriptor_of(descriptor)
    specification(base)  # raises for a descriptor that cannot be saved, before anything is computed
    check_centres(base)
    folder = Folder(root, labelled=True, check=partial(check_classes, goal=goal))
    number_bars(2)
    dataset, unread = signatures(
        folder,
        [base],
        n_workers=n_workers,
        strict=strict,
        also=Measures.requirements,
        **reading,
    )
    failures: list[Failure] | None = None if strict else []
    model = fit_head(
        dataset,
        base,
        goal=goal,
        head=head,
        prior=not no_prior,
        failures=failures,
        n_workers=n_workers,
        progress=True,
    )
    model.save(out, {**model.card, "descriptor": descriptor})
    card = _card(model, out)
    if out.suffix:  # `save` writes a card into a folder
        out.with_suffix(".md").write_text(card, encoding="utf-8")
    print(card.partition("\n\n")[2])
    skipped = [*unread, *(failures or ())]
    print_failures(skipped, len(dataset) - len(failures or ()))
    print(f"written to {out}")
    return {**model.card, "n_refused": len(skipped)}


def classify(
    meshes: list[Path], model: Path, out: Path | None = None, **reading: Any
) -> list[dict[str, Any]]:
    """Classify meshes: print the most probable class of each, its probability, and the meshes that fit no class.

    A mesh that fits no class has no probability: the probabilities of the classes hold for a mesh of one of them.

    Args:
        meshes: mesh files, or one folder.
        model: file or folder that igps fit wrote.
        out: CSV file for the probabilities of all classes, if the mesh is of one of them; the column class is empty
            for a mesh that fits no class.
    """
    from igps.cli.reading import files_or_folder, print_failures, signatures
    from igps.descriptors import load
    from igps.learning.fitting import classifier_of
    from igps.learning.fitting import classify as classify_bodies
    from igps.report.tables import text_table, write_rows

    module = load(model)
    classifier_of(module)  # raises for other models before anything is computed
    dataset, failures = signatures(files_or_folder(meshes), [module], **reading)
    result = classify_bodies(
        dataset,
        module,
        failures=None if reading.get("strict") else failures,
        n_workers=reading.get("n_workers"),
    )
    rows = []
    cells = []
    best = result.probabilities.max(dim=1)
    columns = (result.names, result.predicted, best.values.tolist(), best.indices.tolist())
    for name, predicted, value, likely in zip(*columns, strict=True):
        nearest = result.classes[likely]
        # Probabilities divide 1 among known classes: a body of none has none
        probability = None if predicted is None else value
        rows.append(
            {
                "name": name,
                "class": predicted,
                "most_like": nearest,
                "probability": probability,
            }
        )
        shown = "-" if probability is None else f"{probability:.1%}"
        words = predicted or f"unlike every known class; the nearest is {nearest}"
        cells.append((name, shown, words))
    print(text_table(("body", "probability", "class"), cells, left=("body", "class")))
    print_failures(failures, len(rows))
    n_bodies = sum(module.card.get("classes", {}).values())
    if 0 < n_bodies < _N_BODIES:
        print(
            f"The model was fitted to {n_bodies} bodies. So few do not tell how sure it is: a mesh of no class can get "
            f"100 %. Fit it to {_N_BODIES} at least."
        )
    if out is not None:
        table = [
            (row["name"], row["class"], row["most_like"], *(f"{p:.6f}" for p in probabilities))
            for row, probabilities in zip(rows, result.probabilities.tolist(), strict=True)
        ]
        write_rows(out, ("name", "class", "most_like", *result.classes), table)
    return rows


def _card(model: Descriptor, path: Path) -> str:
    card = model.card
    own = card["held_out_scores"]
    plain = card["held_out_scores_of_plain_numbers"]
    scores = "\n".join(
        f"| {_TITLES[name]} | {100 * value:.1f} | {_percent(plain.get(name))} |"
        for name, value in own.items()
    )
    scores = scores or "| none: no class is large enough to hold bodies out | | |"
    classes = ", ".join(f"{name} ({n})" for name, n in card["classes"].items())
    use = {"known": "bodies of its classes", "new": "bodies of classes that it was not fitted to"}[
        card["goal"]
    ]
    return f"""# {path.name}

`{card["descriptor"]}` under the head `{card["head"]}`, {"with" if card["prior"] else "without"} a prior metric,
for {use}. Scores in percent, means over held-out folds that neither the fit nor the choice of the head has seen:

| | this model | plain numbers |
|---|---|---|
{scores}
{_rivals(own, plain)}{_warning(sum(card["classes"].values()))}{_choice(card)}
Fitted to {sum(card["classes"].values())} bodies of {len(card["classes"])} classes: {classes}.

Signatures: `{json.dumps(card["signature"])}`. igps {card["version"]}.
"""


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f}"


def _rivals(own: Mapping[str, float], plain: Mapping[str, float]) -> str:
    """Return a paragraph if plain numbers do as well as the model; empty otherwise."""
    for score in ("balanced_accuracy", "ft"):
        if score in own and plain.get(score, -1.0) >= own[score]:
            return """
Plain numbers, such as volume, axes and thickness, find these classes as well or better: the result says little about
form.
"""
    return ""


def _choice(card: Mapping[str, Any]) -> str:
    """Return the table of what could be chosen, and what tells the classes without form."""
    text = ""
    if card["candidates"]:
        rows = [
            f"| {name} | {', '.join(f'{_TITLES[key]} {100 * x:.1f}' for key, x in scores.items())} |"
            for name, scores in card["candidates"].items()
        ]
        table = "\n".join(rows)
        text += f"""
Chosen on held-out bodies of the same folder: {", ".join(card["parts"])} by the head `{card["head"]}`. Scores of each:

| | |
|---|---|
{table}
"""
    for sentence in card["shortcuts"]:
        text += f"\n**Warning**: {sentence}\n"
    return text


def _warning(n_bodies: int) -> str:
    """Return a paragraph on how little a share of few bodies says; empty for more bodies."""
    if n_bodies >= _N_BODIES:
        return ""
    # The exact interval of Clopper and Pearson (1934) where all are right
    low = 0.025 ** (1 / n_bodies)
    return f"""
**Too few bodies for a result**: of {n_bodies} bodies even 100 % means {low:.0%} to 100 % (95 % interval).
"""
