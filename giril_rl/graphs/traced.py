"""A LossModule's losses and gradients as one recorded graph, without Python in between."""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn.modules.conv import _ConvNd

from giril_rl.graphs.module_settings import ModuleSettings
from giril_rl.graphs.recorded import CannotRecord, Function, record

_MOST_GRAPHS = 32


class TracedGradients:
    """Computes a loss module's losses and their gradients by a graph recorded once.

    For networks of a few hundred units most of a gradient step is Python: TensorDict look-ups,
    argument checks, statistics that nobody reads. Here the module's forward and backward pass are
    recorded for one shape as a graph of plain tensor operations, in which whatever does not lead to
    a loss is dropped. The numbers are the module's own, bit for bit, and a step takes less than
    half the time. ``torch.compile`` was both slower to start and slower to run for these sizes on a
    CPU (``tests/benchmarks/parts.py``).

    A module with convolutions is called as it is: they take nearly all of its time, and TorchScript
    does not run their backward pass. There ``compile=True`` pays, up to a third more steps a second
    (``tests/benchmarks/compiled_steps.py``), with numbers that are the same to rounding.

    Each graph is compared with the module's own pass before it is used. Where the two differ, or
    the module's computation depends on the values of a batch or a buffer (a branch, a mask that
    picks rows), the module is called as it is, which a warning says once.

    Parameters and buffers may change in place, and buffers are updated as the module does it.
    Another batch shape, training or eval mode, or another value of a plain attribute (such as a
    coefficient) is recorded anew. Tensors that are neither parameter nor buffer, and the modules
    themselves, must not be replaced.

    Args:
        loss: called with a TensorDict; the entries named ``loss_*`` are summed and differentiated.
        keys: entries of the batch that the loss reads; where their lengths differ, the TensorDict
            that it is called with has no batch dimension.
        log: further scalar entries of the loss's output to return.
        max_grad_norm: joint norm above which the gradients are scaled down to it, as
            :func:`torch.nn.utils.clip_grad_norm_` does; None leaves them.
        compile: compiles the graph, see :func:`giril_rl.graphs.compiled.compiled`.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torch import nn
        >>> class Square(nn.Module):
        ...     def __init__(self):
        ...         super().__init__()
        ...         self.weight = nn.Parameter(torch.tensor(3.0))
        ...     def forward(self, td):
        ...         return TensorDict({"loss_square": (self.weight * td["x"]).square().mean()})
        >>> module = Square()
        >>> step = TracedGradients(module, keys=["x"])
        >>> step(TensorDict({"x": torch.ones(4)}, [4]))["loss_square"]
        tensor(9.)
        >>> module.weight.grad
        tensor(6.)
    """

    def __init__(
        self,
        loss: nn.Module,
        *,
        keys: Sequence[str | tuple[str, ...]],
        log: Sequence[str] = (),
        max_grad_norm: float | None = None,
        compile: bool = False,
    ) -> None:
        self._loss = _Holder(loss)
        self._keys = list(keys)
        self._log = list(log)
        self._max_grad_norm = max_grad_norm
        named = [(k, p) for k, p in self._loss.named_parameters() if p.requires_grad]
        self._names = [name for name, _ in named]
        self.parameters = [p for _, p in named]
        buffers = dict(self._loss.named_buffers())
        self._state = [*(p.detach() for p in self.parameters), *buffers.values()]
        self._buffers = list(buffers)
        self._settings = ModuleSettings(loss)
        self._compile = compile
        convolves = any(isinstance(part, _ConvNd) for part in loss.modules())
        self._recorded = compile or not convolves
        self._graphs: dict[Hashable, tuple[Function, list[str]]] = {}

    def __call__(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Writes every parameter's ``.grad`` (replacing what was there).

        Returns:
            The losses and logged entries, detached scalars.
        """
        return self.step([batch.get(key) for key in self._keys])

    def step(self, inputs: Sequence[Tensor]) -> dict[str, Tensor]:
        """The same for the entries of ``keys`` as plain tensors, in that order."""
        kind: Hashable = None
        if self._recorded:
            kind = (self._settings.read(), *[x.shape for x in inputs], *[x.dtype for x in inputs])
        graph = self._graphs.get(kind)
        if graph is None:
            graph = self._graphs[kind] = self._prepared(inputs)
        function, names = graph
        with torch.no_grad():
            out = function(*self._state, *inputs)
        for parameter, gradient in zip(self.parameters, out, strict=False):
            # A convolution's gradient may come with channels last; torch's fused Adam reads it as
            # the parameter lies in memory, each weight's gradient for another weight.
            same = gradient.stride() == parameter.stride()
            parameter.grad = gradient if same else torch.empty_like(parameter).copy_(gradient)
        return dict(zip(names, out[len(self.parameters) :], strict=True))

    def _prepared(self, inputs: Sequence[Tensor]) -> tuple[Function, list[str]]:
        """What computes losses and gradients of such inputs, and the names of the former."""
        names: list[str] = []
        count, more = len(self.parameters), len(self._state)

        def eager(*tensors: Tensor) -> tuple[Tensor, ...]:
            given = dict(zip(self._names, _leaves(tensors[:count]), strict=True))
            return self._losses_and_gradients(given, tensors[more:], names)

        if not self._recorded:
            return eager, names

        def with_buffers(*tensors: Tensor) -> tuple[Tensor, ...]:
            buffers = dict(zip(self._buffers, tensors[count:more], strict=True))
            given = {**dict(zip(self._names, _leaves(tensors[:count]), strict=True)), **buffers}
            out = self._losses_and_gradients(given, tensors[more:], names)
            for name, buffer in buffers.items():
                if given[name] is not buffer:
                    raise CannotRecord(f"it puts another tensor in the place of its buffer {name}")
            return out

        settings = self._settings.read()
        try:
            if len(self._graphs) == _MOST_GRAPHS:
                raise CannotRecord(f"its batches or attributes have more than {_MOST_GRAPHS} kinds")
            graph = record(
                with_buffers, [*self._state, *inputs], eager=eager, compile=self._compile
            )
            if self._settings.read() != settings:
                raise CannotRecord("its attributes change with each call")
        except CannotRecord as error:
            self._recorded = False
            warnings.warn(
                f"the gradient steps of {type(self._loss.loss).__name__} run as they are, with the "
                f"same numbers and more time in Python, for they cannot be recorded: {error}.",
                stacklevel=2,
            )
            return eager, names
        finally:
            self._settings.write(settings)
        return graph, list(names)

    def _losses_and_gradients(
        self, given: dict[str, Tensor], inputs: Sequence[Tensor], names: list[str]
    ) -> tuple[Tensor, ...]:
        """Gradients, losses and logged entries; the names of the latter two go into ``names``.

        Args:
            given: parameters that require gradients, and buffers to use in place of the module's.
            inputs: the batch's entries.
            names: is overwritten.
        """
        with torch.enable_grad():
            leaves = [given[name] for name in self._names]
            values = dict(zip(self._keys, inputs, strict=True))
            sizes = {x.shape[:1] for x in inputs}
            batch = TensorDict(values, sizes.pop() if len(sizes) == 1 else ())
            out = torch.func.functional_call(self._loss, given, (batch,))
            losses = {k: v for k, v in out.items() if str(k).startswith("loss_")}
            gradients: Sequence[Tensor] = torch.autograd.grad(
                torch.stack([loss.sum() for loss in losses.values()]).sum(),
                leaves,
                allow_unused=True,
                materialize_grads=True,
            )
        if self._max_grad_norm is not None:
            norms = torch.stack([torch.linalg.vector_norm(g) for g in gradients])
            factor = self._max_grad_norm / (torch.linalg.vector_norm(norms) + 1e-6)
            gradients = [g * factor.clamp(max=1.0) for g in gradients]
        logged = {k: out.get(k) for k in self._log}
        names[:] = [*losses, *logged]
        return (*gradients, *(v.detach() for v in losses.values()), *logged.values())


def _leaves(parameters: Sequence[Tensor]) -> list[Tensor]:
    return [p.detach().requires_grad_() for p in parameters]


class _Holder(nn.Module):
    """Hides that :class:`torchrl.objectives.LossModule` lists its parameters in its own way."""

    def __init__(self, loss: nn.Module) -> None:
        super().__init__()
        self.loss = loss

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        return self.loss(batch)
