"""Settings that allow coarse matrix products change no distance bin, and are as they were afterwards."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from igps.nn.axes import euclidean_distances, oriented_pairs
from igps.nn.batch_features import nearest_directions
from igps.nn.histograms import joint_histogram, pair_histogram


def by_backend(name, precision):
    def change():
        backend = getattr(torch.backends, name, None) if name else torch.backends
        owner = getattr(backend, "matmul", None) if name else backend
        if not hasattr(owner, "fp32_precision"):
            pytest.skip("this PyTorch has no precision for each backend")
        owner.fp32_precision = precision

    return change


def allow_tf32():
    torch.backends.cuda.matmul.allow_tf32 = True


SETTINGS = {
    "medium": lambda: torch.set_float32_matmul_precision("medium"),
    "high": lambda: torch.set_float32_matmul_precision("high"),
    "allow_tf32": allow_tf32,
    "mkldnn": by_backend("mkldnn", "bf16"),
    "cuda": by_backend("cuda", "tf32"),
    "all": by_backend("", "bf16"),
}


def state():
    found = []
    try:
        found.append(torch.get_float32_matmul_precision())
    except RuntimeError:
        found.append("contradiction")
    for backend in (torch.backends.cuda, torch.backends.mkldnn):
        found.append(str(getattr(getattr(backend, "matmul", None), "fp32_precision", None)))
    return [*found, str(getattr(torch.backends, "fp32_precision", None))]


@pytest.fixture(params=list(SETTINGS))
def setting(request):
    yield SETTINGS[request.param]
    if hasattr(torch.backends, "fp32_precision"):
        torch.backends.fp32_precision = "none"
    torch.set_float32_matmul_precision("highest")
    for backend in (torch.backends.cuda, torch.backends.mkldnn):
        if hasattr(getattr(backend, "matmul", None), "fp32_precision"):
            backend.matmul.fp32_precision = "none"


def kernels():
    """All that counts pairs by their distance."""
    generator = torch.Generator().manual_seed(0)
    embedding = torch.randn(300, 64, generator=generator) / 8
    points = torch.rand(300, 3, generator=generator)
    directions = torch.nn.functional.normalize(
        torch.randn(300, 3, generator=generator),
        dim=1,
    )
    memberships = torch.rand(300, 2, generator=generator).softmax(dim=1)
    centres = torch.linspace(0.1, 2.5, 30)
    leaf = embedding.clone().requires_grad_()
    joint = joint_histogram(
        memberships, [euclidean_distances(leaf, centres), euclidean_distances(points, centres[:10])]
    )
    cosines = torch.linspace(-0.8, 0.8, 5)
    oriented = joint_histogram(
        torch.ones(300, 1),
        [
            euclidean_distances(embedding, centres[::5]),
            oriented_pairs(points, directions, cosines, cosines),
        ],
    )
    (gradient,) = torch.autograd.grad(joint.square().sum(), leaf)  # counts all pairs once more
    return [
        pair_histogram(embedding, embedding.norm(dim=1)),
        joint.detach(),
        oriented,
        gradient,
        nearest_directions(
            embedding, embedding.flip(0) * 1.1, torch.ones(300, dtype=torch.bool), 3
        ),
    ]


def test_no_bin_changes(setting):
    expected = kernels()
    setting()
    before = state()
    for result, other in zip(kernels(), expected, strict=True):
        assert torch.equal(result, other)
    assert state() == before


def test_threads_share_the_settings(setting):
    """A thread that leaves early must not change the precision of the others; the last one restores the settings."""
    expected = kernels()
    setting()
    before = state()
    with ThreadPoolExecutor(4) as pool:
        for results in pool.map(lambda _: kernels(), range(12)):
            for result, other in zip(results, expected, strict=True):
                torch.testing.assert_close(result, other, rtol=0, atol=1e-6)
    assert state() == before
