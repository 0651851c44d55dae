"""Histograms in other people's pipelines: traced, exported, in double precision, differentiated by their inputs."""

from dataclasses import replace

import pytest
import torch
from torch.autograd import grad
from torch.testing import assert_close

import igps.nn.functional as functional
from batches import alone, exported, tensors, two_bodies
from igps.data.batch import SignatureBatch
from igps.nn.axes import (
    Attribute,
    BallRadius,
    EmbeddedPairCosines,
    EuclideanDistance,
    InteriorDistance,
    PairCosines,
    PairTwist,
    Potential,
)
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms import PairHistogram, PointHistogram


def filtered():
    return SpectralEmbedding(n_eigenpairs=6, n_knots=5)


MODULES = {
    "hard": lambda: PairHistogram(
        [Potential(3), InteriorDistance(7)], SpectralEmbedding(n_eigenpairs=6)
    ),
    "learned": lambda: PairHistogram(
        [
            Potential(2, soft=True, learnable=True),
            Attribute("depth", [0.2, 0.6], soft=True, learnable=True),
            EuclideanDistance(3, learnable=True),
        ],
        filtered(),
    ),
    "in space": lambda: PairHistogram([PairCosines(3, learnable=True)]),
    "in the embedding": lambda: PairHistogram(
        [InteriorDistance(4), EmbeddedPairCosines(3)], filtered()
    ),
    "twists": lambda: PairHistogram([PairTwist(4), InteriorDistance(4)], filtered()),
    "of points": lambda: PointHistogram(
        [BallRadius("inside"), Potential(3, soft=True, learnable=True)], filtered()
    ),
}


@pytest.fixture(params=MODULES)
def module(request):
    return MODULES[request.param]()


def gradients(module, batch):
    loss = module(batch).square().sum()
    return list(grad(loss, list(module.parameters()))) if loss.requires_grad else []


def test_the_whole_graph_is_traced(module):
    batch = two_bodies()
    torch.compiler.reset()
    traced = torch.compile(module, backend="aot_eager", fullgraph=True)
    assert_close(traced(batch), module(batch), rtol=0, atol=1e-6)
    for found, expected in zip(
        gradients(traced, batch),
        gradients(module, batch),
        strict=True,
    ):
        assert_close(found, expected, rtol=1e-4, atol=1e-7)


def test_what_is_compiled_does_not_grow_with_the_samples(module, monkeypatch):
    """Thousands of samples are counted in many blocks: unrolled they would take minutes to compile."""
    monkeypatch.setattr("igps.nn._kernels.pairs_by_torch._BLOCK", 1)
    batch = two_bodies()
    nodes = []
    twice = {
        kind: getattr(batch, kind).map(lambda one: torch.cat([one, one], dim=1))
        for kind in ("interior", "surface")
    }

    def backend(program, _):
        nodes.append(len(program.graph.nodes))
        return program.forward

    for one in (batch, replace(batch, **twice)):
        torch.compiler.reset()
        with torch.no_grad():
            torch.compile(module, backend=backend, fullgraph=True)(one)
    assert nodes[0] == nodes[1]


def test_a_compiled_program_serves_any_number_of_bodies():
    """With fullgraph=True PyTorch compiles eight times and then raises."""
    descriptor = HistogramDescriptor(MODULES["learned"]()).eval()
    batch = two_bodies()
    programs = []

    def backend(program, _):
        programs.append(program)
        return program.forward

    torch.compiler.reset()
    compiled = torch.compile(descriptor, backend=backend, fullgraph=True)
    with torch.no_grad():
        for n in range(2, 6):
            bodies = SignatureBatch.concatenate([batch] * n)
            assert_close(compiled(bodies), descriptor(bodies), rtol=0, atol=1e-6)
    assert len(programs) == 2  # the second time with any number


def test_an_exported_program_takes_any_number_of_bodies_and_samples(module):
    descriptor = HistogramDescriptor(module).eval()
    batch = two_bodies()
    fewer = {
        kind: getattr(batch, kind).map(lambda one: one[:, :30]) for kind in ("interior", "surface")
    }
    with torch.no_grad():
        program = exported(descriptor, batch)
        for one in (
            batch,
            batch[:1],
            SignatureBatch.concatenate([batch, batch[1:]]),
            replace(batch, **fewer),
        ):
            assert_close(program(*tensors(one)), descriptor(one), rtol=0, atol=1e-6)


def test_double_precision_stays_double(module):
    single = module(two_bodies()).detach()
    result = module.double()(two_bodies().to(torch.float64))
    assert result.dtype == torch.float64
    assert_close(result.detach(), single.double(), rtol=0, atol=1e-5)
    assert_close(
        result.flatten(1).sum(dim=1).detach(),
        torch.ones(2).double(),
        rtol=0,
        atol=1e-12,
    )


def test_gradients_by_positions_and_by_eigenvalues_are_those_of_finite_differences(module):
    """Finite differences at the largest entry; the gradient at padding is 0, also at its infinite eigenvalues."""
    batch = two_bodies().to(torch.float64)
    module = module.double()
    interior, surface = (
        one.points.clone().requires_grad_() for one in (batch.interior, batch.surface)
    )
    eigenvalues = batch.eigenvalues.clone().requires_grad_()
    upstream = torch.randn(
        2, *module.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )

    def loss():
        moved = replace(
            batch,
            eigenvalues=eigenvalues,
            interior=replace(batch.interior, points=interior),
            surface=replace(batch.surface, points=surface),
        )
        return (module(moved) * upstream).sum()

    leaves = (interior, surface, eigenvalues)
    found = grad(loss(), leaves, allow_unused=True)
    compared = 0
    for leaf, gradient in zip(leaves, found, strict=True):
        if gradient is None or not gradient.any():
            continue
        assert torch.isfinite(gradient).all()
        padding = (
            ~batch.interior.mask
            if leaf is interior
            else ~batch.surface.mask
            if leaf is surface
            else leaf.isinf()
        )
        assert not gradient[padding].any()
        entry = int(gradient.abs().argmax())
        moved = []
        with torch.no_grad():
            for step in (1e-6, -2e-6):
                leaf.view(-1)[entry] += step
                moved.append(float(loss()))
            leaf.view(-1)[entry] += 1e-6
        assert float(gradient.view(-1)[entry]) == pytest.approx(
            (moved[0] - moved[1]) / 2e-6, rel=1e-3
        )
        compared += 1
    assert compared > 0


def test_padding_leaves_second_derivatives_as_they_are(module):
    """Of a body whose samples and eigenvalues are padded, and of the same body alone."""
    if any(isinstance(one, EmbeddedPairCosines) for one in module.modules()):
        pytest.skip(
            "first derivatives only: between points of many coordinates PyTorch has no others"
        )
    batch = two_bodies().to(torch.float64)
    module = module.double()
    upstream = torch.randn(
        module.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    found = []
    for one, row in ((batch, 1), (alone(batch, 1), 0)):
        leaves = (one.eigenvalues.clone().requires_grad_(), one.area.clone().requires_grad_())
        cells = module(replace(one, eigenvalues=leaves[0], area=leaves[1]))[row] * upstream
        gradients = grad(cells.sum(), leaves, create_graph=True, allow_unused=True)
        total = sum(
            (g.square().sum() for g in gradients if g is not None), torch.zeros(()).double()
        )
        second = grad(total, leaves, allow_unused=True) if total.requires_grad else (None, None)
        found.append([None if values is None else values[row].flatten()[:7] for values in second])
    for padded, plain in zip(*found, strict=True):
        assert (padded is None) == (plain is None)
        if padded is not None and plain is not None:
            assert_close(padded, plain, rtol=1e-9, atol=1e-12)


def test_a_state_is_read_back_to_the_last_key(module):
    state = {
        name: value + 0.1 if "log" in name else value for name, value in module.state_dict().items()
    }
    module.load_state_dict(state, strict=True)
    with pytest.raises(RuntimeError, match="Unexpected key"):
        module.load_state_dict({**state, "axes.9.start": torch.zeros(1)}, strict=True)


def test_functions_stand_beside_the_modules():
    """The mathematics of a module from its parts: the paper's histogram of a body."""
    batch = two_bodies()
    real = batch.interior.mask[1]
    known = torch.isfinite(batch.eigenvalues[1])
    embedding = functional.spectral_embedding(
        batch.interior.eigenfunctions[1, real][:, known], batch.eigenvalues[1, known]
    )
    found = functional.pair_histogram(embedding, functional.barycentroid_potential(embedding))
    expected = PairHistogram()(batch)[1]
    assert_close(found, expected, rtol=0, atol=1e-6)
    assert (
        float(
            functional.chi_square(
                found[None].flatten(1),
                found[None].flatten(1),
            )
        )
        == 0
    )
    for name in functional.__all__:
        assert callable(getattr(functional, name))
