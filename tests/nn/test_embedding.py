import math

import numpy as np
import pytest
import torch

from igps.nn.embedding import SpectralEmbedding, spectral_embedding

AREA = 2.7


def commute_time_embedding(eigenfunctions, eigenvalues):
    """The Global Point Signature as it is defined: φₖ/√λₖ."""
    return eigenfunctions * eigenvalues.rsqrt().to(eigenfunctions.dtype).unsqueeze(-2)


@pytest.fixture(scope="module")
def spectrum():
    """Eigenfunctions (20, 12) and eigenvalues (12,) of no body in particular."""
    generator = torch.Generator().manual_seed(5)
    eigenvalues = torch.rand(12, generator=generator, dtype=torch.float64).cumsum(0) * 20 + 1
    return torch.randn(20, 12, generator=generator, dtype=torch.float64), eigenvalues


def learned():
    module = SpectralEmbedding(n_knots=9)
    assert module.log_gain is not None
    with torch.no_grad():
        module.log_gain.copy_(
            torch.randn(
                9,
                generator=torch.Generator().manual_seed(1),
            )
        )
    return module


def test_default_is_the_commute_time(spectrum):
    area = torch.tensor(AREA)
    assert torch.equal(SpectralEmbedding()(*spectrum, area), commute_time_embedding(*spectrum))


@pytest.mark.parametrize("is_learned", [False, True])
def test_padding_has_no_weight(spectrum, is_learned):
    functions, values = spectrum
    module = learned() if is_learned else SpectralEmbedding()
    padded_values = torch.full((2, 12), math.inf, dtype=torch.float64)
    padded_values[0] = values
    padded_values[1, :5] = values[:5]
    padded_functions = functions.repeat(2, 1, 1)
    padded_functions[1, :, 5:] = 0
    area = torch.tensor([AREA, 3.1], dtype=torch.float64)
    result = module(padded_functions, padded_values, area)
    assert (module.weights(padded_values, area)[1, 5:] == 0).all()
    assert (result[1, :, 5:] == 0).all()
    assert torch.equal(result[0], module(functions, values, area[0]))
    assert torch.equal(
        result[1, :, :5],
        module(functions[:, :5], values[:5], area[1]),
    )
    if is_learned:
        result.square().sum().backward()
        assert torch.isfinite(module.log_gain.grad).all()
        assert (module.log_gain.grad != 0).any()


def test_keeps_the_first_eigenpairs(spectrum):
    functions, values = spectrum
    area = torch.tensor(AREA)
    for module in (SpectralEmbedding(n_eigenpairs=4), SpectralEmbedding(n_eigenpairs=4, n_knots=3)):
        assert torch.equal(
            module(functions, values, area),
            commute_time_embedding(
                functions[:, :4],
                values[:4],
            ),
        )
    assert torch.equal(
        spectral_embedding(functions, values, n_eigenpairs=4), module(functions, values, area)
    )
    assert SpectralEmbedding(n_eigenpairs=99)(functions, values, area).shape == (20, 12)


def test_learned_filter_interpolates_its_knots_in_log():
    module = learned()
    assert module.log_gain is not None
    gain = module.log_gain.detach().double().numpy()
    x = np.geomspace(0.5, 20_000, 333)
    expected = x**-0.5 * np.exp(
        np.interp(
            np.log(x),
            np.linspace(math.log(2), math.log(5000), 9),
            gain,
        )
    )
    weights = module.weights(torch.from_numpy(x), torch.tensor(1.0)).detach()
    np.testing.assert_allclose(weights, expected, rtol=1e-6)
    assert (weights >= 0).all()


def test_gradient_of_the_filter(spectrum):
    functions, values = spectrum
    module = SpectralEmbedding(n_knots=6).double()
    gain = torch.randn(
        6, generator=torch.Generator().manual_seed(2), dtype=torch.float64, requires_grad=True
    )

    def embedding(gain):
        area = torch.tensor(AREA, dtype=torch.float64)
        return torch.func.functional_call(module, {"log_gain": gain}, (functions, values, area))

    assert embedding(gain).sum().requires_grad
    assert torch.autograd.gradcheck(embedding, (gain,))


def test_result_has_single_precision_at_least(spectrum):
    functions, values = spectrum
    for dtype in (torch.float32, torch.bfloat16):
        result = spectral_embedding(functions.to(dtype), values)
        assert result.dtype == torch.float32
        expected = spectral_embedding(functions.to(dtype).double(), values)
        np.testing.assert_allclose(result, expected, rtol=1e-6)


@pytest.mark.parametrize("options", [{"n_knots": 1}, {"n_eigenpairs": 0}])
def test_bad_filter_is_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        SpectralEmbedding(**options)
