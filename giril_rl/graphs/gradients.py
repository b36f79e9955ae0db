"""A loss module's losses and gradients by one recorded graph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from giril_rl.graphs.functional import FunctionalLoss
from giril_rl.graphs.recording import ModuleGraph, convolves


class TracedGradients:
    """Computes a loss module's losses and gradients by a graph that is recorded once.

    For networks of a few hundred units, most of a gradient step is Python: TensorDict look-ups,
    argument checks, unused statistics. The recorded forward and backward pass gives the same bits
    in less than half the time. ``torch.compile`` was slower to start and to run at these sizes on a
    CPU (``tests/benchmarks/parts.py``). See :class:`~giril_rl.graphs.ModuleGraph` for what may
    change between calls and what happens where no graph can be recorded.

    A module with convolutions is called as it is, since they take nearly all of its time. There
    ``compile=True`` pays: up to a third more steps a second
    (``tests/benchmarks/compiled_steps.py``), with results that are equal up to rounding.

    Args:
        loss: called with a TensorDict; the entries named ``loss_*`` are summed and differentiated.
        keys: the batch entries that the loss reads. Where their lengths differ, the loss gets a
            TensorDict without batch dimension.
        log: further scalar entries of the loss's output to return.
        max_grad_norm: the gradients are scaled down to this joint norm, as by
            :func:`torch.nn.utils.clip_grad_norm_`; None does not clip.
        compile: compiles the graph, see :func:`giril_rl.graphs.compiling.compiled`.

    Examples:
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
        self.module = FunctionalLoss(loss) if FunctionalLoss.is_needed(loss) else _Holder(loss)
        self._keys = list(keys)
        self._log = list(log)
        self._max_grad_norm = max_grad_norm
        trained = {k: p for k, p in self.module.named_parameters() if p.requires_grad}
        self.names, self.parameters = list(trained), list(trained.values())
        self.graph_settings: dict[str, Any] = {
            "label": f"the gradient steps of {type(loss).__name__}",
            "recorded": compile or not convolves(loss),
            "compile": compile,
        }
        self._graph = ModuleGraph(self.module, self.losses_and_gradients, **self.graph_settings)

    def __call__(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Replaces every parameter's ``.grad``.

        Returns:
            The losses and logged entries, detached scalars.
        """
        return self.step([batch.get(key) for key in self._keys])

    def step(self, inputs: Sequence[Tensor]) -> dict[str, Tensor]:
        """The same for the entries of ``keys`` as plain tensors, in that order."""
        out = self._graph(inputs)
        for name, parameter in zip(self.names, self.parameters, strict=True):
            parameter.grad = laid_out(out.pop(name), parameter)
        return out

    def losses_and_gradients(
        self, state: dict[str, Tensor], inputs: Sequence[Tensor]
    ) -> dict[str, Tensor]:
        """What :meth:`step` does, without a graph and without writing the gradients.

        Args:
            state: parameters of ``module`` by name, and buffers that stand in for its own. The
                trained parameters are replaced by copies, and a buffer that the loss replaces.
            inputs: the entries of ``keys``.

        Returns:
            Each trained parameter's gradient by the parameter's name, and the losses.
        """
        with torch.enable_grad():
            leaves = [state[name].detach().requires_grad_() for name in self.names]
            state.update(zip(self.names, leaves, strict=True))
            sizes = {x.shape[:1] for x in inputs}
            batch = TensorDict(
                dict(zip(self._keys, inputs, strict=True)), sizes.pop() if len(sizes) == 1 else ()
            )
            out = torch.func.functional_call(self.module, state, (batch,))
            losses = {k: v for k, v in out.items() if str(k).startswith("loss_")}
            gradients: Sequence[Tensor] = torch.autograd.grad(
                [loss.sum() for loss in losses.values()],
                leaves,
                allow_unused=True,
                materialize_grads=True,
            )
        if self._max_grad_norm is not None:
            norm = torch.nn.utils.get_total_norm(gradients)
            factor = (self._max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
            gradients = [gradient * factor for gradient in gradients]
        return {
            **dict(zip(self.names, gradients, strict=True)),
            **{k: v.detach() for k, v in losses.items()},
            **{k: out.get(k).detach() for k in self._log},
        }


def laid_out(gradient: Tensor, parameter: Tensor) -> Tensor:
    """A gradient with its parameter's memory layout, which torch's fused Adam takes it to have.

    A convolution's gradient may have channels last.
    """
    if gradient.stride() == parameter.stride():
        return gradient
    return torch.empty_like(parameter).copy_(gradient)


class _Holder(nn.Module):
    """Lists the parameters of a :class:`torchrl.objectives.LossModule` as other modules do."""

    def __init__(self, loss: nn.Module) -> None:
        super().__init__()
        self.loss = loss

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        return self.loss(batch)
