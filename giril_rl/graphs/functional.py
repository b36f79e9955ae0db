"""TorchRL's functional losses as modules whose parameters can be exchanged for a call."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams
from torch import Tensor, nn

_DOT = "|"  # A parameter's name must not contain a dot.


class FunctionalLoss(nn.Module):
    """A loss module that holds its networks' parameters in TensorDictParams, as other modules do.

    :func:`torch.func.functional_call` does not reach such parameters: it would differentiate with
    respect to tensors that the loss never reads, and every gradient would be zero. Here they are
    this module's own, and the loss reads whatever stands in their place.

    Args:
        loss: a :class:`torchrl.objectives.LossModule`, whose parameters and buffers are shared.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import QValueActor
        >>> from torchrl.objectives import DQNLoss
        >>> network = QValueActor(nn.Linear(2, 3), in_keys=["observation"], action_space="one_hot")
        >>> loss = FunctionalLoss(DQNLoss(network, action_space="one_hot"))
        >>> sorted(name for name, _ in loss.named_parameters())
        ['value_network_params|module|0|module|bias', 'value_network_params|module|0|module|weight']
    """

    def __init__(self, loss: nn.Module) -> None:
        super().__init__()
        self._shared = {"loss": loss}  # Not a part, which would list its parameters twice.
        for name, parameter in loss.named_parameters():
            self.register_parameter(name.replace(".", _DOT), parameter)
        for name, buffer in loss.named_buffers():
            self.register_buffer(name.replace(".", _DOT), buffer)
        self._sets = {
            name: part.batch_size
            for name, part in loss.named_children()
            if isinstance(part, TensorDictParams)
        }

    @staticmethod
    def is_needed(loss: nn.Module) -> bool:
        """Whether a module has parameters that ``functional_call`` would not reach."""
        return any(isinstance(part, TensorDictParams) for part in loss.modules())

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        """The loss's output for the parameters and buffers that this module has now."""
        sets: dict[str, dict[str, Tensor]] = {name: {} for name in self._sets}
        others: dict[str, Tensor] = {}
        for key, value in (*self.named_parameters(), *self.named_buffers()):
            name, _, rest = key.partition(_DOT)
            if name in sets:
                sets[name][rest.replace(_DOT, ".")] = value
            else:
                others[key.replace(_DOT, ".")] = value
        instead = {
            name: TensorDict(values, self._sets[name]).unflatten_keys(".")
            for name, values in sets.items()
        }
        loss = self._shared["loss"]
        with _attributes(loss, instead):
            return torch.func.functional_call(loss, others, (batch,), tie_weights=False)


@contextmanager
def _attributes(loss: nn.Module, values: Mapping[str, object]) -> Iterator[None]:
    """Sets attributes of an instance, which are found before its parts of the same names."""
    attributes = vars(loss)
    attributes.update(values, _cache={})  # Where the loss keeps what it derives of parameters.
    try:
        yield
    finally:
        for name in values:
            del attributes[name]
        attributes["_cache"] = {}
