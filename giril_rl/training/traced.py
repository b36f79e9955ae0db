"""A LossModule's losses and gradients as one recorded graph, without Python in between."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from giril_rl.training.recorded import record

_CONVOLUTIONS = (nn.Conv2d, nn.ConvTranspose2d)


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

    Tensors that are not parameters (coefficients, scales) are recorded as they are at the first
    call, so that they must not be replaced later. A new batch shape is recorded anew.

    Args:
        loss: called with a TensorDict; the entries named ``loss_*`` are summed and differentiated.
        keys: entries of the batch that the loss reads; where their lengths differ, the TensorDict
            that it is called with has no batch dimension.
        log: further scalar entries of the loss's output to return.
        max_grad_norm: joint norm above which the gradients are scaled down to it, as
            :func:`torch.nn.utils.clip_grad_norm_` does; None leaves them.
        compile: compiles the graph, see :func:`giril_rl.training.compiled.compiled`.

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
        self._data = [p.detach() for p in self.parameters]
        self._compile = compile
        convolves = any(isinstance(part, _CONVOLUTIONS) for part in loss.modules())
        self._recorded = compile or not convolves
        self._graphs: dict[tuple[torch.Size, ...], tuple[Callable, list[str]]] = {}

    def __call__(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Writes every parameter's ``.grad`` (replacing what was there).

        Returns:
            The losses and logged entries, detached scalars.
        """
        return self.step([batch.get(key) for key in self._keys])

    def step(self, inputs: Sequence[Tensor]) -> dict[str, Tensor]:
        """The same for the entries of ``keys`` as plain tensors, in that order."""
        shapes = tuple(x.shape for x in inputs)
        graph = self._graphs.get(shapes)
        if graph is None:
            graph = self._graphs[shapes] = self._record(inputs)
        function, names = graph
        with torch.no_grad():
            out = function(*self._data, *inputs)
        for parameter, gradient in zip(self.parameters, out, strict=False):
            # A convolution's gradient may come with channels last; torch's fused Adam reads it as
            # the parameter lies in memory, each weight's gradient for another weight.
            same = gradient.stride() == parameter.stride()
            parameter.grad = gradient if same else torch.empty_like(parameter).copy_(gradient)
        return dict(zip(names, out[len(self.parameters) :], strict=True))

    def _record(
        self, inputs: Sequence[Tensor]
    ) -> tuple[Callable[..., tuple[Tensor, ...]], list[str]]:
        names: list[str] = []
        count = len(self._data)

        def losses_and_gradients(*tensors: Tensor) -> tuple[Tensor, ...]:
            with torch.enable_grad():
                leaves = [p.detach().requires_grad_() for p in tensors[:count]]
                values = dict(zip(self._keys, tensors[count:], strict=True))
                sizes = {x.shape[:1] for x in inputs}
                batch = TensorDict(values, sizes.pop() if len(sizes) == 1 else ())
                parameters = dict(zip(self._names, leaves, strict=True))
                out = torch.func.functional_call(self._loss, parameters, (batch,))
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

        if not self._recorded:
            return losses_and_gradients, names
        buffers = list(self._loss.buffers())
        kept = [buffer.clone() for buffer in buffers]
        graph = record(losses_and_gradients, [*self._data, *inputs], compile=self._compile)
        for buffer, before in zip(buffers, kept, strict=True):
            buffer.copy_(before)  # Batch normalisation counts each call.
        return graph, list(names)


class _Holder(nn.Module):
    """Hides that :class:`torchrl.objectives.LossModule` lists its parameters in its own way."""

    def __init__(self, loss: nn.Module) -> None:
        super().__init__()
        self.loss = loss

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        return self.loss(batch)
