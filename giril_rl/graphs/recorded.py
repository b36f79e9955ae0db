"""Recording a function of tensors as a graph that runs without Python."""

from __future__ import annotations

import random
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor, fx
from torch.fx.experimental.proxy_tensor import make_fx

from giril_rl.graphs.compiled import compiled
from giril_rl.runs.randomness import restore_rng, rng_state

Function = Callable[..., tuple[Tensor, ...]]


class CannotRecord(Exception):
    """Why no graph does what a function does.

    Examples:
        >>> raise CannotRecord("it uses Python's random numbers")
        Traceback (most recent call last):
        ...
        giril_rl.graphs.recorded.CannotRecord: it uses Python's random numbers
    """


def record(
    function: Function,
    inputs: Sequence[Tensor],
    *,
    eager: Function | None = None,
    compile: bool = False,
) -> Function:
    """The plain tensor operations that ``function`` does for inputs of these shapes.

    Results that do not lead to an output are left out. Tensors that are not inputs are recorded as
    they are now. Nothing is compiled unless asked for, so that it takes a fraction of a second; the
    numbers are then the function's own, bit for bit, and random operations draw from the global
    generator as before. The graph is run once beside the function, and refused where it differs.

    Args:
        function: a function of tensors that returns a tuple of tensors; it may use autograd inside
            and change its inputs in place.
        inputs: examples of its arguments. The function is called with them twice; they and all
            random states are put back afterwards.
        eager: what the graph must agree with; None takes ``function``.
        compile: see :func:`giril_rl.graphs.compiled.compiled`.

    Returns:
        A function of tensors of the same shapes; call it without gradient.

    Raises:
        CannotRecord: if what the function does depends on the values of its inputs, or if the
            graph's numbers are not the function's.

    Examples:
        >>> double = record(lambda x: (x + x,), [torch.ones(2)])
        >>> double(torch.tensor([1.0, 3.0]))
        (tensor([2., 6.]),)
        >>> record(lambda x: (x if x.sum() > 0 else -x,), [torch.ones(2)])
        Traceback (most recent call last):
        ...
        giril_rl.graphs.recorded.CannotRecord: Python looks at the value of a tensor
    """
    device = inputs[0].device
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # The recorded graph holds nothing that tracing warns of.
        with _put_back(inputs):
            graph = _graph(function, inputs)
        with _put_back(inputs):
            expected = _outcome(eager or function, inputs)
        candidates: list[Function] = [graph]
        if device.type == "cpu" and not compile:
            # TorchScript runs the graph as it is; for a GPU it would compile parts of it anew.
            try:
                with _put_back(inputs):
                    script = torch.jit.trace(graph, tuple(inputs), check_trace=False)
                candidates.insert(0, script)
            except RuntimeError:
                pass  # It has no backward pass of convolutions and of layer normalisation.
        for candidate in candidates:
            with _put_back(inputs):
                same = _same(_outcome(candidate, inputs), expected)
            if same:
                return compiled(candidate, device) if compile else candidate
    raise CannotRecord("recorded, it gives other numbers or draws other random ones")


def _graph(function: Function, inputs: Sequence[Tensor]) -> fx.GraphModule:
    others = random.getstate(), np.random.get_state()[1].tobytes()  # type: ignore[index]
    try:
        graph = make_fx(function)(*inputs)
    except CannotRecord:
        raise
    except Exception as error:
        reason = str(error).strip().partition("\n")[0]
        if "_local_scalar_dense" in reason:
            reason = "Python looks at the value of a tensor"
        raise CannotRecord(reason) from error
    if others != (random.getstate(), np.random.get_state()[1].tobytes()):  # type: ignore[index]
        raise CannotRecord("it draws random numbers by Python or NumPy")
    for node in graph.graph.nodes:
        if _size_depends_on_values(node):
            raise CannotRecord(f"the size of what {node.target} gives depends on its input")
    graph.graph.eliminate_dead_code()
    graph.recompile()
    return graph


def _size_depends_on_values(node: fx.Node) -> bool:
    """Whether an operation gives more or fewer elements for other inputs of the same shape."""
    if torch.Tag.dynamic_output_shape not in getattr(node.target, "tags", ()):
        return False
    if node.target is not torch.ops.aten.index.Tensor:
        return True
    chosen = [part.meta["val"].dtype for part in node.args[1] if part is not None]  # type: ignore
    return torch.bool in chosen or torch.uint8 in chosen


Outcome = tuple[list[Tensor], list[Tensor]]


def _outcome(function: Function, inputs: Sequence[Tensor]) -> Outcome:
    """What a call gives, and what it leaves: its inputs and the random state."""
    given = list(function(*inputs))
    left = [x.clone() for x in inputs]
    return given, [*left, *rng_state(inputs[0].device).values()]


def _same(found: Outcome, expected: Outcome) -> bool:
    return all(
        _equal(one, other)
        for one, other in zip([*found[0], *found[1]], [*expected[0], *expected[1]], strict=True)
    )


def _equal(one: Tensor, other: Tensor) -> bool:
    if one.shape != other.shape or one.dtype != other.dtype:
        return False
    if one.device.type == "cpu" or not one.is_floating_point():
        return torch.allclose(one, other, rtol=0, atol=0, equal_nan=True)
    # Sums on a GPU may be taken in another order at each call.
    return torch.allclose(
        one, other, rtol=1e-3, atol=1e-3 * other.abs().max().item(), equal_nan=True
    )


@contextmanager
def _put_back(inputs: Sequence[Tensor]) -> Iterator[None]:
    """Recording changes neither what is trained nor the run's random numbers."""
    kept = [x.clone() for x in inputs]
    state = rng_state(inputs[0].device)
    others = random.getstate(), np.random.get_state()
    try:
        yield
    finally:
        for x, before in zip(inputs, kept, strict=True):
            if not torch.equal(x, before):
                x.copy_(before)
        restore_rng(state)
        random.setstate(others[0])
        np.random.set_state(others[1])
