"""Whole gradient steps, optimizer and target networks included, as one compiled program."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.optim import Adam
from torchrl.objectives import SoftUpdate

from giril_rl.graphs.gradients import TracedGradients
from giril_rl.graphs.recording import ModuleGraph

_MOMENTS = ("exp_avg", "exp_avg_sq", "step")
_LOSS = "loss."


class CompiledUpdate:
    """Computes gradients, takes Adam's step and moves the target networks by one compiled graph.

    With small networks most of a gradient step is the time between operations: torch's compiler
    joins what is not a matrix product. The numbers are those of ``gradients.step``,
    ``optimizer.step`` and ``targets.step`` one after the other, up to rounding.

    The optimizer keeps its state: it is saved as ever. Once its ``load_state_dict`` was called,
    this object must be made anew, for the optimizer then holds other tensors.

    Args:
        gradients: of the loss, made with ``compile=True``; its own graph is not recorded.
        optimizer: torch's Adam with the ``parameters`` of ``gradients`` in one group, without
            weight decay, amsgrad or maximize. Its step size must stay.
        targets: TorchRL's update of the loss's target networks; None for a loss without.

    Raises:
        ValueError: for other settings of the optimizer, or ``targets`` of a loss that has none.

    Examples:
        >>> from torchrl.modules import QValueActor
        >>> from torchrl.objectives import DQNLoss
        >>> network = QValueActor(nn.Linear(2, 3), in_keys=["observation"], action_space="one_hot")
        >>> loss = DQNLoss(network, action_space="one_hot", delay_value=True)
        >>> after = [("next", name) for name in ("observation", "reward", "done", "terminated")]
        >>> gradients = TracedGradients(loss, keys=["observation", "action", *after], compile=True)
        >>> optimizer = Adam(gradients.parameters, lr=1e-3)
        >>> update = CompiledUpdate(gradients, optimizer, SoftUpdate(loss, tau=0.005))
        >>> losses = update.step(minibatch)  # doctest: +SKIP
    """

    def __init__(
        self,
        gradients: TracedGradients,
        optimizer: Adam,
        targets: SoftUpdate | None = None,
    ) -> None:
        (self._group,) = optimizer.param_groups
        for name in ("weight_decay", "amsgrad", "maximize"):
            if self._group[name]:
                raise ValueError(f"{name}={self._group[name]} is not part of the compiled step")
        _begin(optimizer)
        self._gradients = gradients
        self._module = _WithMoments(gradients, optimizer)
        self._targets: dict[str, str] = {}  # Of TorchRL's losses, by their names.
        if targets is not None:
            trained = set(gradients.names)
            for name, _ in gradients.module.named_buffers():
                if name.removeprefix("target_") in trained:
                    self._targets[name] = name.removeprefix("target_")
            if not self._targets:
                raise ValueError("the loss has no target networks that the update could move")
            self._tau = 1 - targets.eps
        self._graph = ModuleGraph(self._module, self._whole_step, **gradients.graph_settings)

    def step(self, inputs: Sequence[Tensor]) -> dict[str, Tensor]:
        """One step on the entries of the gradients' ``keys``, in that order.

        Returns:
            The losses and logged entries, detached scalars.
        """
        return self._graph(inputs)

    def _whole_step(self, state: dict[str, Tensor], inputs: Sequence[Tensor]) -> dict[str, Tensor]:
        of_loss = {k.removeprefix(_LOSS): v for k, v in state.items() if k.startswith(_LOSS)}
        out = self._gradients.losses_and_gradients(of_loss, inputs)
        names, group = self._gradients.names, self._group
        state.update({_LOSS + k: v for k, v in of_loss.items() if k not in names})
        known = {**dict(self._module.named_buffers()), **state}
        moments = [[known[f"{moment}{n}"] for n in range(len(names))] for moment in _MOMENTS]
        _adam_step(
            [known[_LOSS + name] for name in names],
            [out.pop(name) for name in names],
            *moments,
            lr=group["lr"],
            betas=group["betas"],
            eps=group["eps"],
        )
        if self._targets:
            torch._foreach_lerp_(
                [known[_LOSS + name] for name in self._targets],
                [known[_LOSS + name] for name in self._targets.values()],
                self._tau,
            )
        return out


def _adam_step(
    parameters: list[Tensor],
    gradients: list[Tensor],
    means: list[Tensor],
    squares: list[Tensor],
    steps: list[Tensor],
    *,
    lr: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Adam (Kingma and Ba, 2015, algorithm 1), in place.

    torch's own reads the number of steps in Python unless Dynamo compiles the optimizer itself.
    """
    first, second = betas
    torch._foreach_add_(steps, 1)
    torch._foreach_lerp_(means, gradients, 1 - first)
    torch._foreach_mul_(squares, second)
    torch._foreach_addcmul_(squares, gradients, gradients, 1 - second)
    for parameter, mean, square, step in zip(parameters, means, squares, steps, strict=True):
        root = (square / (1 - second**step)).sqrt()
        parameter.sub_(lr / (1 - first**step) * mean / (root + eps))


def _begin(optimizer: Adam) -> None:
    """Gives each parameter the state that Adam has before its first step."""
    state = optimizer.state_dict()
    if state["state"]:
        return
    (group,) = optimizer.param_groups
    state["state"] = {
        number: {
            "step": torch.zeros((), dtype=torch.float32),
            "exp_avg": torch.zeros_like(parameter, memory_format=torch.preserve_format),
            "exp_avg_sq": torch.zeros_like(parameter, memory_format=torch.preserve_format),
        }
        for number, parameter in enumerate(group["params"])
    }
    optimizer.load_state_dict(state)


class _WithMoments(nn.Module):
    """The loss, and the optimizer's state as buffers."""

    def __init__(self, gradients: TracedGradients, optimizer: Adam) -> None:
        super().__init__()
        self.loss = gradients.module
        (group,) = optimizer.param_groups
        for number, parameter in enumerate(group["params"]):
            for moment in _MOMENTS:
                self.register_buffer(f"{moment}{number}", optimizer.state[parameter][moment])
