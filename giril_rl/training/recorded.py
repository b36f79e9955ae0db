"""Recording a function of tensors as a graph that runs without Python."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from giril_rl.randomness import restore_rng, rng_state
from giril_rl.training.compiled import compiled


def record(
    function: Callable[..., tuple[Tensor, ...]],
    inputs: Sequence[Tensor],
    *,
    compile: bool = False,
) -> Callable[..., tuple[Tensor, ...]]:
    """The plain tensor operations that ``function`` does for inputs of these shapes.

    Results that do not lead to an output are left out. Tensors that are not inputs are recorded as
    they are now. Nothing is compiled unless asked for, so that it takes a fraction of a second; the
    numbers are then the function's own, bit for bit, and random operations draw from the global
    generator as before.

    Args:
        function: a function of tensors that returns a tuple of tensors; it may use autograd inside.
        inputs: examples of its arguments. The function is called with them once.
        compile: see :func:`giril_rl.training.compiled.compiled`.

    Returns:
        A function of tensors of the same shapes; call it without gradient.

    Examples:
        >>> double = record(lambda x: (x + x,), [torch.ones(2)])
        >>> double(torch.tensor([1.0, 3.0]))
        (tensor([2., 6.]),)
    """
    state = rng_state(inputs[0].device)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # The recorded graph holds nothing that tracing warns of.
        graph = make_fx(function)(*inputs)
        graph.graph.eliminate_dead_code()
        graph.recompile()
        device = inputs[0].device
        if compile:
            recorded = compiled(graph, device)
        elif device.type == "cpu":
            # TorchScript runs the graph as it is; for a GPU it would compile parts of it anew.
            recorded = torch.jit.trace(graph, tuple(inputs), check_trace=False)
        else:
            recorded = graph
    restore_rng(state)  # Recording must not consume the run's random numbers.
    return recorded
