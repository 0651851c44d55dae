"""Broken volumes, molecules, scenes and images give a message with a remedy, or correct bodies.

`python tests/campaign/broken_bodies.py --case 123` repeats the trial of one file, and stores the file.
"""

import argparse
import re
import tempfile
import traceback
import warnings
from pathlib import Path

import nibabel
import numpy as np
import SimpleITK
import trimesh
from body_files import body_file, field_at
from broken_meshes import Verdict, count_verdicts
from scipy import ndimage

from igps import LoadOptions, MeshError
from igps.data.attribute_sources import attribute_source
from igps.mesh.loading import BodyRef, each_body, list_bodies

SEED = 17
# Relative tolerances of volumes: of the surface of a label against its voxels, and of a scene.
VOLUME, EXACT = 5e-3, 1e-5
# The end of a message: a remedy after the first sentence
_REMEDY = re.compile(r"[.;:] [A-Z][^.]*.*[.)]$", re.DOTALL)


def examine(job):
    """Try the file of a seed and a number, in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as folder:
        return judge(body_file(*job), Path(folder))


def judge(given, folder):
    """Read the bodies of a file, and check the result."""
    for name, content in given.files.items():
        (folder / name).write_bytes(content)
    path = folder / given.name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if given.kind == "image":
                return _judge_image(given, path)
            load_options = LoadOptions(**given.options)
            bodies = {str(ref.part): (ref, body) for ref, body in each_body(path, load_options)}
            listed = [str(ref.part) for ref in list_bodies(path, load_options)]
        except MeshError as error:
            if given.expected is not None:
                return Verdict("wrong", f"refused, and bodies were expected: {error}")
            return _refused(error, path, folder)
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            return Verdict(
                "wrong",
                f"a traceback of {type(error).__name__} from {where.filename}:{where.lineno}: {error}",
            )
        if listed != list(bodies):
            return Verdict("wrong", f"listed are {listed}, read were {list(bodies)}")
        return _judge_bodies(given, path, bodies)


def _refused(error, name, folder):
    """The verdict on a message, which must contain a name and a remedy."""
    text = str(error)
    if str(name) not in text:
        return Verdict("wrong", f"{name} is not named: {text}")
    if not _REMEDY.search(text):
        return Verdict("wrong", f"no remedy: {text}")
    return Verdict("refused", text.replace(str(folder), "FOLDER"))


def _judge_bodies(given, path, bodies):
    expected = given.expected
    if expected is not None and set(expected) != set(bodies):
        return Verdict("wrong", f"{sorted(bodies)} were read, {sorted(expected)} expected")
    bounds = _bounds(path) if given.kind == "volume" and expected is None else {}
    refusals = []
    for part, (ref, body) in bodies.items():
        wanted = None if expected is None else expected[part]
        if isinstance(body, MeshError):
            verdict = _refused(body, str(ref), path.parent)
            if wanted is not None:
                return Verdict("wrong", f"{part}: refused, {wanted} expected: {body}")
            if verdict.kind == "wrong":
                return verdict
            refusals.append(verdict.reason)
            continue
        surface = trimesh.Trimesh(body.vertices, body.faces, process=False)
        if not surface.is_watertight or not surface.volume > 0:
            return Verdict(
                "wrong", f"{part}: closed {surface.is_watertight}, volume {surface.volume}"
            )
        low, high = bounds.get(part, (0.0, np.inf))
        if wanted is not None:
            error = EXACT if given.kind != "volume" else VOLUME
            low = wanted * (1 - error)
            high = wanted * (1 + error)
        if not low <= surface.volume <= high:
            return Verdict(
                "wrong", f"{part}: volume {surface.volume}, between {low} and {high} expected"
            )
    kind = "refused" if refusals else "confirmed"
    n_confirmed = len(bodies) - len(refusals)
    return Verdict(kind, "; ".join(refusals), ("bodies",) * n_confirmed)


def _bounds(path):
    """Lower and upper bounds of the volume of each label, by another reader.

    The lower bound counts the larger connected components, the upper bound all voxels and filled holes.
    """
    if path.name.endswith(("nii", "gz", "mgz")):
        image = nibabel.load(path)
        values = np.asanyarray(image.dataobj).squeeze()
        affine = np.array(image.affine)
        scale = {"meter": 1e3, "micron": 1e-3}
        cell = abs(np.linalg.det(affine[:3, :3]))
        if path.name.endswith(("nii", "nii.gz")):
            cell *= scale.get(image.header.get_xyzt_units()[0], 1.0) ** 3
    elif path.suffix in (".nrrd", ".mha"):
        image = SimpleITK.ReadImage(str(path))
        values = SimpleITK.GetArrayFromImage(image)
        cell = abs(
            np.prod(image.GetSpacing()) * np.linalg.det(np.reshape(image.GetDirection(), (3, 3)))
        )
    else:
        return {}
    bounds = {}
    for value in np.unique(values).tolist():
        mask = values == value
        label, n_components = ndimage.label(mask, np.ones((3, 3, 3)))
        sizes = np.bincount(label.ravel())[1:] if n_components else np.zeros(1)
        low = sizes[sizes >= 0.02 * sizes.sum()].sum()
        high = ndimage.binary_fill_holes(mask).sum()
        # Joining components that share a corner adds voxels.
        bounds[str(int(value))] = (cell * low * (1 - VOLUME), cell * high * 1.05)
    return bounds


def _judge_image(given, path):
    image = next(name for name in given.files if name != given.name)
    points = np.random.default_rng(0).normal(size=(200, 3))
    points *= 2.5 / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 2.5)
    body = BodyRef(path)
    source = attribute_source(image)
    try:
        source.cache_tag(body)
        values = source(body, points)
    except MeshError as error:
        if given.expected is not None:
            return Verdict("wrong", f"refused, and values were expected: {error}")
        return _refused(error, path, path.parent)
    if not np.isfinite(values).all() or np.abs(values).max() > 1e15:
        return Verdict("wrong", f"values up to {np.abs(values).max()}")
    if given.expected is not None:
        error = np.abs(values - field_at(points))
        if error.max() > 1e-2:
            return Verdict(
                "wrong", f"values are off by {np.quantile(error, 0.9)}, at most {error.max()}"
            )
    return Verdict("confirmed", "", ("values",))


def campaign(n_cases, n_workers=None):
    """Try `n_cases` files."""
    return count_verdicts(
        "broken bodies",
        "volumes, molecules, scenes; images, grids and vertex values beside bodies",
        "a sentence that names file, body and remedy, or right bodies; no fault of one loses another",
        examine,
        [(SEED, number) for number in range(n_cases)],
        lambda number: body_file(SEED, number).story,
        n_workers,
    )


def main():
    """Repeat one case and print its verdict."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", type=int, required=True, help="number of the file")
    parser.add_argument(
        "--out", type=Path, default=Path("build/campaign"), help="folder for the file"
    )
    arguments = parser.parse_args()
    given = body_file(SEED, arguments.case)
    arguments.out.mkdir(parents=True, exist_ok=True)
    print(arguments.out / given.name, given.story, given.expected, sep="\n")
    print(judge(given, arguments.out))


if __name__ == "__main__":
    main()
