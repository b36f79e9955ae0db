"""Sends a reward's new weights to its copies in a collector's workers."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.weight_update import SharedMemWeightSyncScheme
from torchrl.weight_update.weight_sync_schemes import WeightStrategy

from giril_rl.errors import UserError


class RewardWeightSyncScheme(SharedMemWeightSyncScheme):
    """Sends a reward's weights to the environments of a collector of several processes.

    Use it in ``weight_sync_schemes`` of TorchRL's multi-process collectors, under the reward's path
    in a worker's collector. A worker starts with the weights that the module has when the collector
    is made. ``update_policy_weights_`` with that path as ``model_id`` sends later ones. Parameters
    and buffers are sent; the state of a noise generator is not.

    TorchRL's own schemes (0.14.1) do not work here: they look for the module in the main process's
    collector, which has none, take its extra state for a dictionary, and wait after an update for
    an answer that a worker gives for its policy only.

    Args:
        module: the reward that is trained in this process; the workers' copies have its shapes.

    Raises:
        UserError: if it is not a module, or if the weights do not fit the copies.

    Examples:
        >>> from giril_rl.rewards import ConstantReward
        >>> scheme = RewardWeightSyncScheme(ConstantReward())
        >>> schemes = {"env.transform[0].module": scheme}

        ``MultiSyncCollector(..., weight_sync_schemes={"policy": SharedMemWeightSyncScheme(),
        **schemes})``, and after training
        ``collector.update_policy_weights_(model_id="env.transform[0].module")``.
    """

    def __init__(self, module: nn.Module) -> None:
        if not isinstance(module, nn.Module):
            raise UserError(f"{type(module).__name__} has no weights: give the reward module.")
        super().__init__()
        self.strategy = _CopyWeights()
        self._source: nn.Module | None = module

    def _init_on_sender_impl(
        self, *, model_id: str | None = None, context: Any = None, ctx: Any = None, **kwargs: Any
    ) -> None:
        # A copy, so that workers see no training before it is sent.
        weights = self.strategy.extract_weights(self._source).clone()
        devices = [torch.device("cpu")] * context.num_workers
        super()._init_on_sender_impl(model_id=model_id, weights=weights, devices=devices, ctx=ctx)

    def _init_on_receiver_impl(self, **kwargs: Any) -> None:
        super()._init_on_receiver_impl(**kwargs)
        # With a context, an update would go to it, and it handles a policy only.
        self.context = None

    def prepare_weights(
        self, weights: Any, model_id: str, strategy: WeightStrategy, context: Any = None
    ) -> Any:
        """The weights to send; by default those of the scheme's module."""
        weights = self._source if weights is None else weights
        return super().prepare_weights(weights, model_id, strategy, context)

    def __getstate__(self) -> dict[str, Any]:
        """The state for a worker: the queues, not the module."""
        return {**super().__getstate__(), "_source": None}


class _CopyWeights(WeightStrategy):
    """Weights as a TensorDict on the CPU, copied into the existing tensors."""

    def extract_weights(self, source: Any) -> Any:
        if isinstance(source, nn.Module):
            source = TensorDict.from_module(source)
        if isinstance(source, TensorDictBase):
            return source.data.to("cpu")
        return super().extract_weights(source)

    @torch.no_grad()
    def apply_weights(self, destination: Any, weights: Any, inplace: bool = True) -> None:
        own = TensorDict.from_module(destination)
        for key, tensor in own.items(True, True):
            value = weights.get(key, None)
            if value is None or value.shape != tensor.shape:
                raise UserError(
                    f"the weight {key!r} of the reward in a worker is missing in the weights sent, "
                    "or has another shape: build both in the same way."
                )
            # Not through .data: caches of what is computed from a weight must see the change.
            tensor.copy_(value)
