"""Functions of batches whose gradients are computed on one thread of the numerical libraries."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from igps._threads import one_thread
from igps.data.batch import SignatureBatch
from igps.nn._kernels.blocks import uses_loops


def on_one_thread(
    function: Callable[[SignatureBatch], Tensor], batch: SignatureBatch, module: nn.Module
) -> Tensor:
    """Apply a function of a module to a batch so that its gradients, too, are computed on one thread.

    Whoever calls `loss.backward()` has as many threads as PyTorch chooses, which wait for each other at each operation
    if other processes are busy, see `igps._threads`. On other devices and in traced code there is no limit.
    """
    if not uses_loops(batch.device):
        return function(batch)
    inputs: list[Tensor] = []

    def collect(tensor: Tensor) -> Tensor:
        if tensor.requires_grad:
            inputs.append(tensor)
        return tensor

    batch.map(collect)
    learned = [x for x in (*module.parameters(), *module.buffers()) if x.requires_grad]
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
