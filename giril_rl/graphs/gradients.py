"""A loss module's losses and gradients by one recorded graph."""

from __future__ import annotations

from collections.abc import Sequence

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
        self._loss = FunctionalLoss(loss) if FunctionalLoss.is_needed(loss) else _Holder(loss)
        self._keys = list(keys)
        self._log = list(log)
        self._max_grad_norm = max_grad_norm
        trained = {k: p for k, p in self._loss.named_parameters() if p.requires_grad}
        self._names = list(trained)
        self.parameters = list(trained.values())
        self._graph = ModuleGraph(
            self._loss,
            self._losses_and_gradients,
            label=f"the gradient steps of {type(loss).__name__}",
            recorded=compile or not convolves(loss),
            compile=compile,
        )

    def __call__(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Replaces every parameter's ``.grad``.

        Returns:
            The losses and logged entries, detached scalars.
        """
        return self.step([batch.get(key) for key in self._keys])

    def step(self, inputs: Sequence[Tensor]) -> dict[str, Tensor]:
        """The same for the entries of ``keys`` as plain tensors, in that order."""
        out = self._graph(inputs)
        for name, parameter in zip(self._names, self.parameters, strict=True):
            gradient = out.pop(name)
            # A convolution's gradient may have channels last, but torch's fused Adam takes
            # parameter and gradient to have the same memory layout.
            same = gradient.stride() == parameter.stride()
            parameter.grad = gradient if same else torch.empty_like(parameter).copy_(gradient)
        return out

    def _losses_and_gradients(
        self, state: dict[str, Tensor], inputs: Sequence[Tensor]
    ) -> dict[str, Tensor]:
        with torch.enable_grad():
            leaves = [state[name].detach().requires_grad_() for name in self._names]
            state.update(zip(self._names, leaves, strict=True))
            sizes = {x.shape[:1] for x in inputs}
            batch = TensorDict(
                dict(zip(self._keys, inputs, strict=True)), sizes.pop() if len(sizes) == 1 else ()
            )
            out = torch.func.functional_call(self._loss, state, (batch,))
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
            **dict(zip(self._names, gradients, strict=True)),
            **{k: v.detach() for k, v in losses.items()},
            **{k: out.get(k).detach() for k in self._log},
        }


class _Holder(nn.Module):
    """Lists the parameters of a :class:`torchrl.objectives.LossModule` as other modules do."""

    def __init__(self, loss: nn.Module) -> None:
        super().__init__()
        self.loss = loss

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        return self.loss(batch)
