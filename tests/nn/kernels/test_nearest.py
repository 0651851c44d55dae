import pytest
import torch

from igps.nn._kernels.neighbours import smallest


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [0, 1, 8, 40])
def test_the_smallest_of_each_row_are_those_of_a_sort(n, dtype):
    values = torch.rand(50, 40, generator=torch.Generator().manual_seed(n), dtype=dtype)
    values[3, 5:20] = torch.inf
    ordered = values.sort(dim=1)
    kept, columns = smallest(values.t().contiguous().t(), n)
    assert torch.equal(kept, ordered.values[:, :n])
    finite = kept.isfinite()
    assert torch.equal(values.gather(1, columns)[finite], kept[finite])
    assert torch.equal(columns[finite], ordered.indices[:, :n][finite])


def test_of_equal_entries_the_first_are_kept():
    found = smallest(torch.zeros(2, 6), 3)[1].tolist()
    expected = [[0, 1, 2], [0, 1, 2]]
    assert found == expected
