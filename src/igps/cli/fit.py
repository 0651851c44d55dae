"""`igps fit` and `igps classify`."""

import json
from functools import partial
from pathlib import Path
from typing import Any

from igps.analysis.fitting import Goal, HeadName, check_classes, classifier_of
from igps.analysis.fitting import classify as classify_bodies
from igps.analysis.fitting import fit as fit_head
from igps.cli.reading import Folder, files_or_folder, print_failures, signatures
from igps.data.dataset import Failure
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors import load
from igps.nn.description import check_centres
from igps.nn.descriptor import Descriptor
from igps.nn.specification import IN_FOLDER, specification
from igps.report.tables import write_rows

_TITLES = {
    "nn": "NN",
    "ft": "FT",
    "dcg": "DCG",
    "accuracy": "classified correctly",
    "calibration_error": "expected calibration error",
    "unknown_auc": "a class left out called unknown, AUC",
}


def fit(
    root: Path,
    out: Path,
    descriptor: str = "pretrained",
    goal: Goal = "known",
    head: HeadName = "auto",
    no_prior: bool = False,
    n_workers: int | None = None,
    strict: bool = False,
    **reading: Any,
) -> dict[str, Any]:
    """Fit a metric or a classifier to a labelled folder, for igps classify and the --descriptor of commands.

    A card of it, with scores on bodies that were held out, is written beside it, or into its folder, in Markdown.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        out: the model, a file ending in .safetensors, or a folder to share.
        descriptor: a name (a wrong one lists all), a file, or package.module:NAME of one of your own.
        goal: known for the classes of the folder; new for a metric of classes that come up later.
        head: classifier, whitened, or as_is for the descriptor itself; auto takes the best on held-out bodies.
        no_prior: ignore the descriptor's own metric, and fit to its histograms alone
    """
    if out.is_dir() and not (out / IN_FOLDER).is_file() and (found := next(out.iterdir(), None)):
        raise ValueError(f"out: expected a new folder, or that of a model, {out} holds {found.name}. Name another.")
    chosen = descriptor_of(descriptor)
    specification(chosen)  # refuses what no file can hold before anything is computed
    check_centres(chosen)
    folder = Folder(root, labelled=True, check=partial(check_classes, goal=goal))
    dataset, unread = signatures(folder, [chosen], n_workers=n_workers, strict=strict, **reading)
    failures: list[Failure] | None = None if strict else []
    model = fit_head(
        dataset, chosen, goal=goal, head=head, prior=not no_prior, failures=failures, n_workers=n_workers, progress=True
    )
    model.save(out, {**model.card, "descriptor": descriptor})
    card = _card(model, out)
    if out.suffix:  # a folder has one
        out.with_suffix(".md").write_text(card, encoding="utf-8")
    print(card.partition("\n\n")[2])
    refused = [*unread, *(failures or ())]
    print_failures(refused, len(dataset) - len(failures or ()))
    print(f"written to {out}")
    return {**model.card, "n_refused": len(refused)}


def classify(meshes: list[Path], model: Path, out: Path | None = None, **reading: Any) -> list[dict[str, Any]]:
    """Classify meshes: the most probable class of each, its probability, and which meshes fit none.

    Args:
        meshes: mesh files, or one folder.
        model: a file that igps fit wrote.
        out: a table with the probabilities of all classes, a file ending in .csv; class is empty where none fits.
    """
    chosen = load(model)
    classifier_of(chosen)  # refuses others before anything is computed
    dataset, failures = signatures(files_or_folder(meshes), [chosen], **reading)
    found = classify_bodies(
        dataset, chosen, failures=None if reading.get("strict") else failures, n_workers=reading.get("n_workers")
    )
    width = max(map(len, found.names))
    print(f"{'mesh':<{width}}  {'probability':>11}  class")
    rows = []
    best = found.probabilities.max(dim=1)
    columns = (found.names, found.predicted, best.values.tolist(), best.indices.tolist())
    for name, predicted, value, likely in zip(*columns, strict=True):
        told = f"unlike everything known, most like {found.classes[likely]}" if predicted is None else predicted
        print(f"{name:<{width}}  {value:>11.1%}  {told}")
        rows.append({"name": name, "class": predicted, "most_like": found.classes[likely], "probability": value})
    print_failures(failures, len(rows))
    if out is not None:
        values = zip(rows, found.probabilities.tolist(), strict=True)
        table = [
            (row["name"], row["class"], row["most_like"], *(f"{p:.6f}" for p in of_each)) for row, of_each in values
        ]
        write_rows(out, ("name", "class", "most_like", *found.classes), table)
    return rows


def _card(model: Descriptor, path: Path) -> str:
    """A page on a fitted model."""
    card = model.card
    scores = "\n".join(f"| {_TITLES[name]} | {100 * value:.1f} |" for name, value in card["held_out_scores"].items())
    scores = scores or "| none: no class is large enough to hold bodies out | |"
    classes = ", ".join(f"{name} ({n})" for name, n in card["classes"].items())
    what = {"known": "bodies of its classes", "new": "bodies of classes that it was not fitted to"}[card["goal"]]
    return f"""# {path.name}

`{card["descriptor"]}` under the head `{card["head"]}`, {"beside" if card["prior"] else "without"} a prior metric,
for {what}. Held out, in percent, mean over folds that neither the fit nor the choice of the head has seen:

| | |
|---|---|
{scores}

Fitted to {sum(card["classes"].values())} bodies of {len(card["classes"])} classes: {classes}.

Signatures: `{json.dumps(card["signature"])}`. igps {card["version"]}.
"""
