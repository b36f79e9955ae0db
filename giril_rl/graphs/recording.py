"""Records what a function does with tensors as a graph that gives the same bits."""

from __future__ import annotations

import random
import warnings
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx, nn
from torch.fx.experimental.proxy_tensor import make_fx
from torch.nn.modules.conv import _ConvNd

from giril_rl.errors import first_line
from giril_rl.graphs.compiling import compiled
from giril_rl.runs.randomness import restore_rng, rng_state

Function = Callable[..., tuple[Tensor, ...]]
_MOST_GRAPHS = 32


class CannotRecord(Exception):
    """Says why no graph can replace a function."""


class ModuleGraph:
    """Calls a function of a module's state through a recorded graph.

    One graph is recorded for each combination of input shapes, dtypes and plain attributes of the
    module and its parts: numbers, flags (``training``) and strings. Parameters and buffers may
    change in place. Modules must not be replaced, nor tensors that are neither parameter nor
    buffer.

    Each graph must first give the same bits as the function itself. Where none does, for example
    because the function branches on a tensor's value, the function is called instead, and one
    warning says so.

    Args:
        module: owns the parameters and buffers that the function uses.
        function: called with a part of the module's state by name, for
            :func:`torch.func.functional_call`, and a sequence of inputs; returns named tensors.
        label: the subject of the warning, a plural.
        recorded: False always calls the function.
        compile: compiles the graph, see :func:`giril_rl.graphs.compiling.compiled`.

    Examples:
        >>> linear = nn.Linear(2, 1)
        >>> def positive(state, inputs):
        ...     return {"out": torch.func.functional_call(linear, state, tuple(inputs)).relu()}
        >>> graph = ModuleGraph(linear, positive, label="calls")
        >>> graph([torch.ones(3, 2)])["out"].shape
        torch.Size([3, 1])
    """

    def __init__(
        self,
        module: nn.Module,
        function: Callable[[dict[str, Tensor], Sequence[Tensor]], Mapping[str, Tensor]],
        *,
        label: str,
        recorded: bool = True,
        compile: bool = False,
    ) -> None:
        parameters, buffers = dict(module.named_parameters()), dict(module.named_buffers())
        self._parameters, self._buffers = list(parameters), list(buffers)
        self._state = [x.detach() for x in (*parameters.values(), *buffers.values())]
        self._function, self._label = function, label
        self._settings = _Settings(module)
        self._recorded, self._compile = recorded, compile
        self._graphs: dict[Hashable, tuple[Function, list[str]]] = {}

    def __call__(self, inputs: Sequence[Tensor]) -> dict[str, Tensor]:
        """What the function returns for the module's present state, without gradient."""
        return dict(zip(*self.run(inputs), strict=True))

    def run(self, inputs: Sequence[Tensor]) -> tuple[list[str], tuple[Tensor, ...]]:
        """The same as names and values, which saves a microsecond."""
        kind: Hashable = None
        if self._recorded:
            kind = (self._settings.read(), *[x.shape for x in inputs], *[x.dtype for x in inputs])
        graph = self._graphs.get(kind)
        if graph is None:
            graph = self._graphs[kind] = self._prepare(inputs)
        function, names = graph
        with torch.no_grad():
            return names, function(*self._state, *inputs)

    def _prepare(self, inputs: Sequence[Tensor]) -> tuple[Function, list[str]]:
        names: list[str] = []
        count, size = len(self._parameters), len(self._state)

        def call(state: dict[str, Tensor], inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
            out = self._function(state, inputs)
            names[:] = out
            return tuple(out.values())

        def eager(*tensors: Tensor) -> tuple[Tensor, ...]:
            return call(dict(zip(self._parameters, tensors[:count], strict=True)), tensors[size:])

        def pure(*tensors: Tensor) -> tuple[Tensor, ...]:
            """Uses no tensor but its arguments."""
            buffers = dict(zip(self._buffers, tensors[count:size], strict=True))
            state = {**dict(zip(self._parameters, tensors[:count], strict=True)), **buffers}
            out = call(state, tensors[size:])
            for name, buffer in buffers.items():
                if state[name] is not buffer:
                    raise CannotRecord(f"the module replaces its buffer {name}")
            return out

        if not self._recorded:
            return eager, names
        settings = self._settings.read()
        try:
            if len(self._graphs) == _MOST_GRAPHS:
                raise CannotRecord(f"batches or attributes have more than {_MOST_GRAPHS} kinds")
            graph = record(pure, [*self._state, *inputs], eager=eager, compile=self._compile)
            if self._settings.read() != settings:
                raise CannotRecord("the module's attributes change with each call")
        except CannotRecord as error:
            self._recorded = False
            warnings.warn(
                f"{self._label} cannot be recorded as a graph and run as they are, with the same "
                f"numbers but more slowly: {error}.",
                stacklevel=2,
            )
            return eager, names
        finally:
            self._settings.write(settings)
        return graph, list(names)


class _Settings:
    """The plain attributes of a module's parts, by which Python decides while a graph is recorded.

    Names with a leading underscore and attributes that are added later are not included.
    """

    def __init__(self, module: nn.Module) -> None:
        self._places = [
            (vars(part), name)
            for part in module.modules()
            for name, value in vars(part).items()
            if isinstance(value, bool | int | float | str) and not name.startswith("_")
        ]

    def read(self) -> tuple[Any, ...]:
        return tuple([attributes[name] for attributes, name in self._places])

    def write(self, values: tuple[Any, ...]) -> None:
        for (attributes, name), value in zip(self._places, values, strict=True):
            attributes[name] = value


def convolves(module: nn.Module) -> bool:
    """Whether a module has convolutions, beside which the time in Python is negligible.

    Examples:
        >>> convolves(nn.Sequential(nn.Conv2d(1, 1, 3), nn.ReLU())), convolves(nn.Linear(1, 1))
        (True, False)
    """
    return any(isinstance(part, _ConvNd) for part in module.modules())


def record(
    function: Function,
    inputs: Sequence[Tensor],
    *,
    eager: Function | None = None,
    compile: bool = False,
) -> Function:
    """Records the operations of a function for inputs of these shapes, in a fraction of a second.

    Operations that no output depends on are dropped, and tensors that are not inputs become
    constants. The graph gives the same bits as the function and draws the same numbers from torch's
    global generator: it is run once beside the function and refused where it differs.

    Args:
        function: maps tensors to a tuple of tensors. It may use autograd inside and change its
            inputs in place.
        inputs: example arguments. They and all random states are restored.
        eager: what the graph must agree with; ``function`` if None.
        compile: see :func:`giril_rl.graphs.compiling.compiled`.

    Returns:
        A function of tensors of the same shapes, to be called without gradient.

    Raises:
        CannotRecord: if the operations depend on the inputs' values, or if the results differ.

    Examples:
        >>> double = record(lambda x: (x + x,), [torch.ones(2)])
        >>> double(torch.tensor([1.0, 3.0]))
        (tensor([2., 6.]),)
        >>> record(lambda x: (x if x.sum() > 0 else -x,), [torch.ones(2)])
        Traceback (most recent call last):
        ...
        giril_rl.graphs.recording.CannotRecord: Python looks at the value of a tensor
    """
    device = inputs[0].device
    with torch.no_grad():
        with _restored(inputs):
            graph = _graph(function, inputs)
        with _restored(inputs):
            expected = _outcome(eager or function, inputs)
        candidates: list[Function] = [graph]
        if device.type == "cpu" and not compile:
            with _restored(inputs):
                candidates = [*_in_torchscript(graph, inputs), graph]
        for candidate in candidates:
            with _restored(inputs):
                found = _outcome(candidate, inputs)
            same = all(_equal(one, other) for one, other in zip(found, expected, strict=True))
            if same:
                return compiled(candidate, device) if compile else candidate
    raise CannotRecord("the graph gives other numbers or draws other random ones")


def _in_torchscript(graph: fx.GraphModule, inputs: Sequence[Tensor]) -> list[Function]:
    """The graph in TorchScript, whose interpreter calls operations with the least overhead.

    torch deprecates TorchScript. Without it the graph itself runs, with the same bits, at about
    half the speed for small networks on a CPU. On a GPU, TorchScript would compile parts anew.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return [torch.jit.trace(graph, tuple(inputs), check_trace=False)]
    except (AttributeError, RuntimeError):
        return []  # Some backward passes are missing, such as those of layer normalisation.


def _graph(function: Function, inputs: Sequence[Tensor]) -> fx.GraphModule:
    others = random.getstate(), np.random.get_state()[1].tobytes()  # type: ignore[index]
    try:
        graph = make_fx(function)(*inputs)
    except CannotRecord:
        raise
    except Exception as error:
        reason = first_line(error)
        if "_local_scalar_dense" in reason:
            reason = "Python looks at the value of a tensor"
        raise CannotRecord(reason) from error
    if others != (random.getstate(), np.random.get_state()[1].tobytes()):  # type: ignore[index]
        raise CannotRecord("Python or NumPy draws random numbers")
    for node in graph.graph.nodes:
        if _size_depends_on_values(node):
            raise CannotRecord(f"the size of the result of {node.target} depends on its input")
    graph.graph.eliminate_dead_code()
    graph.recompile()
    return graph


def _size_depends_on_values(node: fx.Node) -> bool:
    if torch.Tag.dynamic_output_shape not in getattr(node.target, "tags", ()):
        return False
    if node.target is not torch.ops.aten.index.Tensor:
        return True
    chosen = [part.meta["val"].dtype for part in node.args[1] if part is not None]  # type: ignore
    return torch.bool in chosen or torch.uint8 in chosen


def _outcome(function: Function, inputs: Sequence[Tensor]) -> list[Tensor]:
    """A call's results, and what it leaves behind: its inputs and the random state."""
    results = function(*inputs)
    left = [x.clone() for x in inputs]
    return [*results, *left, *rng_state(inputs[0].device).values()]


def _equal(one: Tensor, other: Tensor) -> bool:
    if one.shape != other.shape or one.dtype != other.dtype:
        return False
    if one.device.type == "cpu" or not one.is_floating_point():
        return torch.allclose(one, other, rtol=0, atol=0, equal_nan=True)
    # A GPU may add in another order at each call.
    bound = 1e-3 * other.abs().max().item()
    return torch.allclose(one, other, rtol=1e-3, atol=bound, equal_nan=True)


@contextmanager
def _restored(inputs: Sequence[Tensor]) -> Iterator[None]:
    """Restores the inputs and all random states."""
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
