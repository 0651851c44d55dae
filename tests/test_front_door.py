"""What `import igps` gives and costs, and that all it takes is declared."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import igps

PROJECT = Path(__file__).parents[1]
PACKAGE = Path(igps.__file__).parent

# Frozen: whoever adds a name takes one away, and says so here and in the documentation.
NAMES = ["ArticulatedShapes", "BodyDescriptor", "Descriptor", "HistogramDescriptor"]
NAMES += ["LoadOptions", "Mesh", "MeshError", "PairHistogram", "RetrievalLearner"]
NAMES += ["SignatureBatch", "SignatureConfig", "SignatureDataset", "SpectralEmbedding"]
NAMES += ["as_mesh", "collate", "compute_signature", "describe", "descriptor", "fit", "inside"]
NAMES += ["load", "load_mesh", "measures", "retrieval_scores", "search"]

# Import names whose distribution is called otherwise.
DISTRIBUTIONS = {
    "igl": "libigl",
    "umap": "umap-learn",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "yaml": "PyYAML",
}


def test_front_door_has_these_names_and_no_others():
    assert sorted(igps.__all__) == sorted(NAMES)
    assert len(set(NAMES)) == len(NAMES) <= 25
    rooms = {path.stem for path in PACKAGE.iterdir()}
    public = {name for name in vars(igps) if not name.startswith("_")} - rooms
    untold = public - {*NAMES, "annotations", "importlib", "TYPE_CHECKING", "Any"}
    assert not untold


def test_every_name_opens():
    for name in NAMES:
        assert getattr(igps, name).__module__.startswith("igps."), name


def printed(words):
    """What a process of its own prints, which finds this package alone on its path."""
    environment = {"PYTHONPATH": str(PACKAGE.parent), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return done.stdout.strip()


def test_import_loads_nothing_heavy():
    heavy = [
        "torch",
        "numpy",
        "scipy",
        "numba",
        "trimesh",
        "sklearn",
        "skimage",
        "igl",
        "matplotlib",
    ]
    heavy += ["pytorch_lightning", "torchmetrics", "pandas", "jinja2", "nibabel", "argparse"]
    words = f"import sys; import igps; print([name for name in {heavy!r} if name in sys.modules])"
    assert printed(words) == "[]"


def test_lazy_names_do_load_what_they_need():
    words = "import sys, igps; igps.RetrievalLearner; print('pytorch_lightning' in sys.modules)"
    assert printed(words) == "True"


def direct_imports(node):
    """Top-level modules of an import statement."""
    if isinstance(node, ast.Import):
        return {alias.name.split(".")[0] for alias in node.names}
    return {node.module.split(".")[0]} if node.module and not node.level else set()


def imported(path):
    """Top-level modules that a file imports when it runs: not those for type checkers alone."""
    found = set()

    def look(node):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for child in node.orelse:
                look(child)
            return
        if isinstance(node, ast.Import | ast.ImportFrom):
            found.update(direct_imports(node))
        for child in ast.iter_child_nodes(node):
            look(child)

    look(ast.parse(path.read_text()))
    return found


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


# What a program compares with, and no extra needs.
COMPARED_WITH = {"radiomics"}
# Numba works with one version of llvmlite only, and requires it: a range of our own would add nothing.
BROUGHT_ALONG = {"llvmlite": "numba"}


def test_what_is_brought_along_is_required_by_what_brings_it():
    for name, parent in BROUGHT_ALONG.items():
        assert name in declared(importlib.metadata.requires(parent) or [])


def declared(requirements):
    names = [re.split(r"[\s\[<>=!~;]", requirement, maxsplit=1)[0] for requirement in requirements]
    return {normal(name) for name in names}


def test_every_import_is_declared():
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    core = declared(project["dependencies"])
    extras = project["optional-dependencies"]
    extras = {name: declared(extras[name]) for name in set(extras) - {"test", "lint", "docs"}}
    optional = set().union(*extras.values()) - {"interior-gps"}
    known = core | optional | set(BROUGHT_ALONG) | COMPARED_WITH
    used = set()
    for folder in (PACKAGE, PROJECT / "training", PROJECT / "docs" / "benchmarks"):
        for path in sorted(folder.rglob("*.py")):
            others = imported(path) - set(sys.stdlib_module_names) - {"igps", "training", "docs"}
            names = {normal(DISTRIBUTIONS.get(module, module)) for module in others}
            assert names <= known, f"{path} imports what pyproject.toml does not declare"
            used |= names
    # And nothing is declared that is not used.
    assert core <= used
    # trimesh imports that of CAD
    assert optional - extras["cad"] <= used


def test_modules_that_import_at_once_need_no_extra():
    """What a file imports at its top must be a dependency, unless the file is the door of an extra."""
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    core = declared(project["dependencies"])
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Import | ast.ImportFrom):
                modules = direct_imports(node) - set(sys.stdlib_module_names) - {"igps"}
                needed = {normal(DISTRIBUTIONS.get(module, module)) for module in modules}
                assert needed <= core, f"{path} needs {needed - core} at once"


def test_distributions_are_called_so():
    """The names above are those under which the modules are installed."""
    installed = importlib.metadata.packages_distributions()
    for module, distribution in DISTRIBUTIONS.items():
        if module in installed:
            assert normal(distribution) in {normal(one) for one in installed[module]}
