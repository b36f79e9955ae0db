"""An agent's policy as the module that acts in an environment."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

if TYPE_CHECKING:
    from giril_rl.policies.agents import Agent


class ActingPolicy(TensorDictModuleBase):
    """Samples an action, or takes the mode under ``ExplorationType.DETERMINISTIC``.

    Reads ``"observation"``, wherever it is; writes, in the same place, the agent's
    ``acting_keys``, which the loss or the advantages read again and so need not compute.

    Args:
        agent: a policy and value network.

    Examples:
        >>> from tensordict import TensorDict
        >>> from giril_rl.policies.pixel_policy import PixelActorCritic
        >>> frames = torch.zeros(3, 4, 84, 84, dtype=torch.uint8)
        >>> acted = ActingPolicy(PixelActorCritic(6))(TensorDict({"observation": frames}, [3]))
        >>> acted["action"].shape, acted["state_value"].shape
        (torch.Size([3]), torch.Size([3, 1]))
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.in_keys = ["observation"]
        self.out_keys = list(agent.acting_keys)
        self.agent = agent

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action for ``"observation"`` of any leading shape."""
        seen = tensordict.get("observation")
        out = self.act(seen.to(self.agent.device))
        for key, value in zip(self.out_keys, out, strict=True):
            tensordict.set(key, value.to(seen.device))
        return tensordict

    def act(self, observation: Tensor) -> tuple[Tensor, ...]:
        """What is written for observations that are where the weights are."""
        greedy = exploration_type() == ExplorationType.DETERMINISTIC
        return self.agent.act(observation, greedy=greedy)
