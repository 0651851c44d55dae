"""How a function of a batch is computed: by loops or by PyTorch, for how many bodies at once, on one thread."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils._pytree import tree_leaves

from igps._threads import one_thread
from igps.data.batch import SignatureBatch

BLOCK = 2**25
"""Number of entries in a block; enough to keep a GPU busy."""

# Bodies are processed together if their numbers of samples differ by at most this share of the larger number, or by
# so few that padding takes less time than a call of all functions.
_MAX_PADDING, _FREE_PADDING = 0.25, 500


def uses_loops(device: torch.device) -> bool:
    """Whether tensors of a device are processed by compiled loops; otherwise operations of PyTorch are used."""
    return device.type == "cpu" and not torch.compiler.is_compiling()


def map_bodies(
    function: Callable[..., Tensor], points: Tensor, others: Tensor, *more: Tensor
) -> Tensor:
    """Apply a function to tensors of N bodies, (N, P, ...), (N, T, ...) and more, in batches of bodies.

    The function takes memory for P·T pairs of each body. On the CPU a batch is one body, whose pairs then stay in the
    cache; on other devices a batch has up to `BLOCK` pairs. Traced code processes all bodies at once.
    """
    tensors = (points, others, *more)
    if torch.compiler.is_compiling():
        return function(*tensors)
    n_bodies = 1
    if not uses_loops(points.device):
        n_pairs = points.shape[1] * others.shape[1]
        n_bodies = max(1, BLOCK // max(1, n_pairs))
    in_batches = [tensor.split(n_bodies) for tensor in tensors]
    return torch.cat([function(*batch) for batch in zip(*in_batches, strict=True)])


def map_by_size(
    function: Callable[[SignatureBatch], Tensor],
    batch: SignatureBatch,
    n_read: tuple[float, float] = (math.inf, math.inf),
) -> Tensor:
    """Apply a function to a batch, in groups of bodies of about one size, padded only to the largest of the group.

    Otherwise, one large body would multiply the time and memory of all. If the function reads at most `n_read` interior
    and surface samples of each body, larger bodies count as of this size. Traced code processes all bodies at once, as
    it cannot depend on their sizes.
    """
    if torch.compiler.is_compiling() or batch.device.type == "meta":
        return function(batch)
    lengths = [_last(batch.interior.mask), _last(batch.surface.mask)]
    sizes: list[list[int]] = torch.stack(lengths, dim=1).tolist()
    read = []
    for n_interior, n_surface in sizes:
        read.append((min(n_interior, n_read[0]), min(n_surface, n_read[1])))
    groups = _of_about_one_size(read)
    if len(groups) > 1 and uses_loops(batch.device):
        # One body is a view of the batch, but several are copied, which costs more than a call for a large body.
        small = [group for group in groups if max(read[group[0]]) <= _FREE_PADDING]
        large = [group for group in groups if group not in small]
        groups = small + [[i] for group in large for i in group]

    def cut_to(members: list[int]) -> SignatureBatch:
        n_interior = max(sizes[i][0] for i in members)
        n_surface = max(sizes[i][1] for i in members)
        interior = batch.interior.map(lambda values: values[:, :n_interior])
        surface = batch.surface.map(lambda values: values[:, :n_surface])
        return replace(batch, interior=interior, surface=surface)

    if len(groups) == 1:
        return function(cut_to(groups[0]))
    results = []
    for group in groups:
        is_one = len(group) == 1
        members = slice(group[0], group[0] + 1) if is_one else group
        results.append(function(cut_to(group)[members]))
    order = torch.tensor([i for group in groups for i in group], device=batch.device)
    return torch.cat(results)[order.argsort()]


def _last(mask: Tensor) -> Tensor:
    """Return the numbers (N,) of the last true entries of a mask (N, P), counted from 1, or 0 without any."""
    numbers = mask * torch.arange(1, mask.shape[1] + 1, device=mask.device)
    return functional.pad(numbers, (1, 0)).amax(dim=1)


def _of_about_one_size(sizes: list[tuple[float, float]]) -> list[list[int]]:
    """Return the numbers of bodies in groups of about one size, from the largest to the smallest."""
    groups: list[list[int]] = []
    for number in sorted(range(len(sizes)), key=sizes.__getitem__, reverse=True):
        if groups and _are_near(sizes[groups[-1][0]], sizes[number]):
            groups[-1].append(number)
        else:
            groups.append([number])
    return groups


def _are_near(size: tuple[float, float], other: tuple[float, float]) -> bool:
    for a, b in zip(size, other, strict=True):
        padding = abs(a - b)
        if padding > _FREE_PADDING and padding > _MAX_PADDING * max(a, b):
            return False
    return True


def on_one_thread(
    function: Callable[[SignatureBatch], Tensor], batch: SignatureBatch, module: nn.Module
) -> Tensor:
    """Apply a function of a module to a batch so that its gradients, too, are computed on one thread.

    Whoever calls `loss.backward()` has as many threads as PyTorch chooses, which wait for each other at each operation
    if other processes are busy, see `igps._threads`. On other devices and in traced code there is no limit.
    """
    if not uses_loops(batch.device):
        return function(batch)
    inputs = [tensor for tensor in tree_leaves(batch) if tensor.requires_grad]
    tensors = (*module.parameters(), *module.buffers())
    learned = [tensor for tensor in tensors if tensor.requires_grad]
    if not torch.is_grad_enabled() or not (inputs or learned):
        with one_thread():
            return function(batch)
    result: Tensor = _OnOneThread.apply(function, batch, learned, *learned, *inputs)
    return result


class _OnOneThread(torch.autograd.Function):
    """The result of a function of a batch, with its graph, in which `backward` goes back on one thread."""

    @staticmethod
    def forward(
        ctx: Any,
        function: Callable[[SignatureBatch], Tensor],
        batch: SignatureBatch,
        learned: list[Tensor],
        *_: Tensor,
    ) -> Tensor:
        ctx.function = function
        ctx.batch = batch
        ctx.learned = learned
        ctx.random_state = torch.get_rng_state()
        ctx.result, ctx.aliases = _with_graph(function, batch)
        output: Tensor = ctx.result.detach()
        if not ctx.result.requires_grad:
            ctx.mark_non_differentiable(output)
        return output

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        result = ctx.result
        aliases = ctx.aliases
        if torch.is_grad_enabled():
            # Second derivatives free the graph of the first ones, so these need a graph of their own, of the same
            # samples.
            with torch.random.fork_rng(devices=[]):
                torch.set_rng_state(ctx.random_state)
                result, aliases = _with_graph(ctx.function, ctx.batch)
        with one_thread():
            gradients = torch.autograd.grad(
                result,
                [*ctx.learned, *aliases],
                upstream,
                retain_graph=True,  # it is freed with the result
                create_graph=torch.is_grad_enabled(),
                allow_unused=True,
            )
        return None, None, None, *gradients


def _with_graph(
    function: Callable[[SignatureBatch], Tensor], batch: SignatureBatch
) -> tuple[Tensor, list[Tensor]]:
    """Return the result of a function, with its graph, and the tensors of the batch by which it has derivatives."""
    aliases: list[Tensor] = []

    def alias(tensor: Tensor) -> Tensor:
        # A tensor of a batch may depend on another one; through an alias, it has only its own derivative.
        if not tensor.requires_grad:
            return tensor
        aliases.append(tensor.view_as(tensor))
        return aliases[-1]

    with one_thread(), torch.enable_grad():
        result = function(batch.map(alias))
    return result, aliases
