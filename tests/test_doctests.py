"""The examples in public docstrings run, and print what they say."""

import doctest
import importlib
from pathlib import Path

import pytest

import igps

PACKAGE = Path(igps.__file__).parent
MODULES = sorted(
    ".".join(("igps", *path.relative_to(PACKAGE).with_suffix("").parts))
    for path in PACKAGE.rglob("*.py")
    if ">>>" in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", igps.__all__)
def test_every_public_name_has_an_example(name):
    assert ">>> " in (getattr(igps, name).__doc__ or "")


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_a_module(name):
    module = importlib.import_module(name)
    found = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert found.attempted > 0
    assert found.failed == 0
