"""Distances between queries (Q, ...) and gallery descriptors (G, ...), as tensors (Q, G).

Smaller is closer, identical descriptors have distance exactly 0, and a distance matrix of a set with itself is exactly
symmetric. All dimensions after the first are cells of a histogram or entries of a vector.

All functions run on the device of their inputs, and in float32 for inputs in half precision. They are differentiable:
χ² any number of times, the others once. They raise a ValueError for unsuitable shapes, dtypes or devices, for NaN or
infinity, and χ² for negative entries; the check waits for the device.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from igps._threads import Team
from igps.retrieval.distance_loops import fill

Distance = Callable[[Tensor, Tensor], Tensor]
"""A distance function: queries (Q, ...) and gallery (G, ...) to distances (Q, G) ≥ 0, smaller is closer."""

# A tile of (query, gallery, cell) triples fits the cache of a CPU, and makes few, large kernel launches on other
# devices. At most three temporaries of that size exist at once, so that they stay below 256 MiB on any device.
_CPU_TILE_BYTES = 2**20
_DEVICE_TILE_BYTES = 48 * 2**20
_CELLS_PER_TILE = 4096
# Smallest number of triples per thread of the compiled loops, which takes some milliseconds.
_TRIPLES_PER_THREAD = 2**24
# Fewer triples take PyTorch less than ten milliseconds; to load the compiled loops takes half a second.
_MIN_TRIPLES = 2**22


def chi_square(queries: Tensor, gallery: Tensor) -> Tensor:
    """χ² distance ½ Σ (a−b)² / (a+b) between histograms, over all cells, with the factor ½.

    The distance of two histograms of sum 1 lies in [0, 1], and is 1 if no cell is filled in both. To weight a cell,
    multiply its entries in both histograms by the weight. A cell that is empty in both adds nothing; its gradients are
    set to zero, because the function has no derivative there. Memory beyond inputs, result and gradients stays below
    256 MiB, but derivatives of gradients hold all triples of query, gallery and cell. Source: Rustamov 2010.

    Example:
        >>> import torch
        >>> histograms = torch.tensor([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.0, 0.0, 1.0]])
        >>> chi_square(histograms[:1], histograms)
        tensor([[0.0000, 0.5000, 1.0000]])

    Args:
        queries: (Q, ...) histograms, entries ≥ 0.
        gallery: (G, ...) histograms of the same cells.

    Returns:
        (Q, G) distances, without unit.
    """
    a, b = _as_rows(queries, gallery, non_negative=True)
    return _ChiSquare.apply(a, b)


def euclidean(queries: Tensor, gallery: Tensor) -> Tensor:
    """Euclidean distance √(Σ (a−b)²), in the unit of the descriptors; the gradient at distance 0 is set to 0."""
    a, b = _as_rows(queries, gallery, non_negative=False)
    return _row_distance(a, b)


def cosine(queries: Tensor, gallery: Tensor) -> Tensor:
    """Cosine distance 1 − cos(a, b), in [0, 2], as ½ ‖a/‖a‖ − b/‖b‖‖², which avoids cancellation for close descriptors.

    A descriptor of length zero has no direction and raises a ValueError.
    """
    a, b = _as_rows(queries, gallery, non_negative=False)
    chord = _row_distance(_unit("queries", a), _unit("gallery", b))
    return chord.square() / 2.0


class _ChiSquare(torch.autograd.Function):
    """χ² tile by tile. The backward pass recomputes the tiles, so that no array (Q, G, cells) is stored."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        ctx.save_for_backward(a, b)
        if _uses_loops(a, b):
            return _sums_by_loops(a, b, chi_square=True).mul_(0.5)
        distances = a.new_zeros(len(a), len(b))
        for q, g, c in _tiles(a, b):
            ratio, difference = _ratio(a[q, c], b[g, c])
            distances[q, g] += ratio.mul_(difference).sum(-1)
        return distances.mul_(0.5)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        a, b = ctx.saved_tensors
        if torch.is_grad_enabled():  # derivatives of the gradient are needed, too
            distances = _chi_square_by_torch(a, b)
            gradients: list[Tensor | None] = []
            for rows in (a, b):
                gradient = None
                if rows.requires_grad:
                    (gradient,) = torch.autograd.grad(distances, rows, grad, create_graph=True)
                gradients.append(gradient)
            return tuple(gradients)
        grad_a = torch.zeros_like(a)
        grad_b = torch.zeros_like(b)
        for q, g, c in _tiles(a, b):
            # With u = (a−b)/(a+b): ∂/∂a (a−b)²/(a+b) = 2u − u², and ∂/∂b = −2u − u².
            ratio, _ = _ratio(a[q, c], b[g, c])
            first = ratio * grad[q, g, None]
            second = ratio.mul_(first)
            grad_a[q, c] += first.sum(1) - second.sum(1) / 2
            grad_b[g, c] -= first.sum(0) + second.sum(0) / 2
        return grad_a, grad_b


def _chi_square_by_torch(a: Tensor, b: Tensor) -> Tensor:
    """χ² in operations of PyTorch, which have derivatives of any order and hold arrays (Q, G, cells)."""
    total = a[:, None] + b
    is_filled = total > 0
    difference = torch.where(is_filled, a[:, None] - b, 0)
    terms = difference.square() / torch.where(is_filled, total, 1)
    return terms.sum(dim=-1) / 2


def _uses_loops(a: Tensor, b: Tensor) -> bool:
    """Whether compiled loops can read rows, on the CPU and not traced, and are worth being loaded."""
    if a.device.type != "cpu" or torch.compiler.is_compiling():
        return False
    return len(a) * len(b) * a.shape[1] > _MIN_TRIPLES


def _sums_by_loops(a: Tensor, b: Tensor, *, chi_square: bool) -> Tensor:
    """Sums (Q, G) of `distance_loops.fill`; the longer one of queries and gallery is divided among threads."""
    sums = a.new_empty(len(a), len(b))
    queries = a.detach().contiguous().numpy()
    gallery = b.detach().contiguous().numpy()
    result = sums.numpy()

    def write(part: slice) -> None:
        if len(a) >= len(b):
            fill(queries[part], gallery, chi_square, result[part])
        else:
            fill(queries, gallery[part], chi_square, result[:, part])

    length = max(len(a), len(b))
    if sums.numel() * a.shape[1] <= 2 * _TRIPLES_PER_THREAD:
        write(slice(length))
        return sums
    with Team() as team:
        step = max(1, math.ceil(length / (4 * team.n_threads)))
        parts = [slice(begin, begin + step) for begin in range(0, length, step)]
        team.each(write, parts)
    return sums


def _ratio(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """(a−b)/(a+b), 0 where both are 0, and a−b for all pairs of rows, each (Q, G, cells)."""
    difference = a[:, None] - b
    total = a[:, None] + b
    total.clamp_min_(torch.finfo(a.dtype).tiny)  # 0/tiny = 0: an empty cell needs no mask
    ratio = torch.div(difference, total, out=total)
    return ratio, difference


def _tiles(a: Tensor, b: Tensor) -> Iterator[tuple[slice, slice, slice]]:
    """Slices (queries, gallery, cells) of tiles of bounded size that cover all triples."""
    n_queries, n_cells = a.shape
    n_gallery = len(b)
    n_bytes = _CPU_TILE_BYTES if a.device.type == "cpu" else _DEVICE_TILE_BYTES
    cells = min(n_cells, _CELLS_PER_TILE)
    pairs = max(1, n_bytes // (cells * a.element_size()))
    # As many rows as columns, or more if the gallery is short.
    rows = max(math.isqrt(pairs), pairs // max(1, n_gallery))
    rows = max(1, min(n_queries, rows))
    columns = max(1, min(n_gallery, pairs // rows))
    for q in range(0, n_queries, rows):
        for g in range(0, n_gallery, columns):
            for c in range(0, n_cells, cells):
                yield slice(q, q + rows), slice(g, g + columns), slice(c, c + cells)


def _row_distance(a: Tensor, b: Tensor) -> Tensor:
    needs_gradients = torch.is_grad_enabled() and (a.requires_grad or b.requires_grad)
    if _uses_loops(a, b) and not needs_gradients:
        return _sums_by_loops(a, b, chi_square=False).sqrt_()
    # Without the faster matrix product, whose cancellation leaves non-zero distances on the diagonal.
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def square_root(values: Tensor) -> Tensor:
    """Square root of non-negative values, whose gradient at 0 is 0 in place of infinity."""
    is_positive = values > 0
    roots = torch.where(is_positive, values, 1.0).sqrt()
    return torch.where(is_positive, roots, 0.0)


def _unit(name: str, rows: Tensor) -> Tensor:
    is_traced = torch.compiler.is_compiling()  # traced code cannot depend on values of tensors
    if not is_traced:
        lengths = torch.linalg.vector_norm(rows, dim=1, keepdim=True)
        limits = torch.finfo(rows.dtype)
        is_usual = (lengths > limits.tiny**0.25) & (lengths < limits.max**0.25)
        if bool(is_usual.all()):
            return rows / lengths
    # Divide by the largest entry first: the sum of squares of tiny or huge entries leaves the range of the dtype.
    largest = rows.detach().abs().amax(dim=1, keepdim=True)
    n_empty = 0 if is_traced else int((largest == 0).sum())
    if n_empty:
        raise ValueError(
            f"{name}: expected descriptors of non-zero length, {n_empty} of {len(rows)} are all zeros and have no "
            "direction; remove them or use another distance"
        )
    scaled = rows / largest
    return scaled / torch.linalg.vector_norm(scaled, dim=1, keepdim=True)


def check_tensor(name: str, value: Any) -> None:
    """Raise a ValueError if an argument is not a tensor, but for example a NumPy array."""
    if not isinstance(value, Tensor):
        raise ValueError(
            f"{name}: expected a tensor, got {type(value).__name__}; convert with torch.as_tensor"
        )


def _as_rows(queries: Tensor, gallery: Tensor, *, non_negative: bool) -> tuple[Tensor, Tensor]:
    """Check both arguments, and return them as (Q, cells) and (G, cells) of one dtype of at least 32 bits."""
    _check_descriptions("queries", queries, non_negative=non_negative)
    _check_descriptions("gallery", gallery, non_negative=non_negative)
    if queries.shape[1:] != gallery.shape[1:]:
        raise ValueError(
            f"gallery: expected descriptors of the shape of the queries, {tuple(queries.shape[1:])}, got "
            f"{tuple(gallery.shape[1:])}; compute both with the same configuration"
        )
    if queries.device != gallery.device:
        raise ValueError(
            f"gallery: expected the queries' device {queries.device}, got {gallery.device}; move one"
        )
    dtype = torch.promote_types(queries.dtype, gallery.dtype)
    dtype = torch.promote_types(dtype, torch.float32)
    return queries.flatten(1).to(dtype), gallery.flatten(1).to(dtype)


def _check_descriptions(name: str, tensor: Tensor, *, non_negative: bool) -> None:
    check_tensor(name, tensor)
    if tensor.ndim < 2 or tensor.shape[1:].numel() == 0:
        raise ValueError(
            f"{name}: expected shape (N, ...) with at least one entry per descriptor, got {tuple(tensor.shape)}; "
            "a single descriptor needs a leading dimension, descriptor[None]"
        )
    if not tensor.is_floating_point():
        raise ValueError(
            f"{name}: expected a real floating dtype, got {tensor.dtype}; convert with .float()"
        )
    if torch.compiler.is_compiling() or tensor.numel() == 0:
        return
    extremes = torch.aminmax(tensor.detach())  # both are NaN if any entry is NaN
    low, high = torch.stack(extremes).tolist()
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError(
            f"{name}: expected finite entries, got NaN or infinity; look for the descriptor with them"
        )
    if non_negative and low < 0:
        raise ValueError(
            f"{name}: expected entries ≥ 0, got {low:g}; compare embeddings by euclidean or cosine"
        )
