from __future__ import annotations

import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies_on_disk import write_body

import igps.data.recipe as recipe_module
from igps.data.recipe import Recipe
from igps.geometry.mesh import MeshError
from igps.geometry.reading import MeshReading
from igps.geometry.signature import SignatureConfig, compute_signature

CONFIG = SignatureConfig(n_eigenpairs=12, resolution=8, min_samples=0, n_surface_samples=20)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_body(tmp_path / "egg.off", 1.1, 1.5)
    return tmp_path / "egg.off"


@pytest.fixture
def recipe(tmp_path: Path) -> Recipe:
    return Recipe(CONFIG, MeshReading(), tmp_path / "cache")


def test_a_signature_is_computed_once_and_is_that_of_the_mesh(
    recipe: Recipe, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not recipe.is_cached(path)
    first = recipe.signature(path)
    assert recipe.is_cached(path)
    expected = compute_signature(recipe.mesh(path), CONFIG)

    def no_more(*_: object) -> None:
        pytest.fail("computed again")

    monkeypatch.setattr(recipe_module, "compute_signature", no_more)
    for found in (first, recipe.signature(path)):
        np.testing.assert_array_equal(found.interior.eigenfunctions, expected.interior.eigenfunctions)
        np.testing.assert_array_equal(found.eigenvalues, expected.eigenvalues)


def test_fill_caches_and_returns_nothing(recipe: Recipe, path: Path) -> None:
    assert recipe.fill(path) is None  # type: ignore[func-returns-value]
    assert recipe.is_cached(path)


def test_a_worker_gets_a_small_copy(recipe: Recipe, path: Path) -> None:
    sent = pickle.dumps(recipe)
    assert len(sent) < 2000
    assert pickle.loads(sent) == recipe
    assert pickle.loads(sent).key(path) == recipe.key(path)


def test_keys_are_told_apart_by_content_reading_parameters_and_suffix_alone(
    recipe: Recipe, path: Path, tmp_path: Path
) -> None:
    copy, renamed, other = tmp_path / "copy.off", tmp_path / "egg.obj", tmp_path / "other.off"
    shutil.copy(path, copy)
    shutil.copy(path, renamed)
    write_body(other, 1.1, 1.6)
    assert recipe.key(copy) == recipe.key(path)
    assert replace(recipe, cache_dir=tmp_path).key(path) == recipe.key(path)
    recipes = [recipe, replace(recipe, config=replace(CONFIG, seed=1))]
    recipes += [
        replace(recipe, reading=reading)
        for reading in (
            MeshReading("never"),
            MeshReading("always"),
            MeshReading(component="largest"),
            MeshReading(allow_open=True),
        )
    ]
    keys = [one.key(path) for one in recipes] + [recipe.key(renamed), recipe.key(other)]
    assert len(set(keys)) == len(keys)


def test_keys_are_those_of_the_caches_that_exist(recipe: Recipe, tmp_path: Path) -> None:
    """Frozen: another key leaves all caches useless. It changes with ALGORITHM_VERSION alone."""
    (tmp_path / "frozen.off").write_bytes(b"OFF\n")
    assert SignatureConfig.ALGORITHM_VERSION == 3
    assert recipe.key(tmp_path / "frozen.off") == "f3de6688b1db864db53947e7043284b6dae4394c17e8a65a0ef5a8e84af8b84f"


def test_a_missing_file_is_named(recipe: Recipe, tmp_path: Path) -> None:
    gone = tmp_path / "gone.off"
    assert not recipe.is_cached(gone)
    for function in (recipe.key, recipe.signature, recipe.mesh):
        with pytest.raises(MeshError, match=r"gone\.off"):
            function(gone)
