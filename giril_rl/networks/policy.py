"""The policy and value network of PPO, as the collector, the loss and the evaluation see them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Categorical, TensorSpec

from giril_rl.networks.acting import ActingPolicy
from giril_rl.networks.distributions import CategoricalActions, DiagonalGaussian
from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.networks.vectors import mlp
from giril_rl.pretrained import Pretrained, remembered

NORMALISED = "normalised"


class ActorCritic(Pretrained, nn.Module):
    """Separate policy and value networks over one running observation normalisation.

    Gaussian actions with a standard deviation that does not depend on the state (first 1), or
    categorical ones. Orthogonal initialisation with gain sqrt(2), the policy's head 0.01, the
    value's 1.

    Args:
        observation_size: size of the observation vector.
        action_spec: the environment's action spec, Box-like or :class:`torchrl.data.Categorical`.
        hidden: hidden layers of either network (tanh); the paper uses two of 100.
        normalise: whether observations are normalised with running statistics.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> agent = ActorCritic(4, Categorical(2, shape=(1,)))
        >>> policy = agent.acting()
        >>> policy(TensorDict({"observation": torch.zeros(3, 4)}, [3]))["action"].shape
        torch.Size([3])
    """

    acting_keys = ("action", "action_log_prob", NORMALISED)
    """What :meth:`act` returns, as the acting policy writes it."""
    input_keys: tuple[str, ...] = (NORMALISED,)
    """What the networks in PPO's loss read of a minibatch."""

    @remembered
    def __init__(
        self,
        observation_size: int,
        action_spec: TensorSpec,
        *,
        hidden: Sequence[int] = (100, 100),
        normalise: bool = True,
    ) -> None:
        super().__init__()
        self.discrete = isinstance(action_spec, Categorical)
        size = action_spec.space.n if self.discrete else action_spec.shape[-1]
        self.normaliser = RunningNormaliser(observation_size) if normalise else nn.Identity()
        self.actor = _orthogonal(mlp(observation_size, size, hidden), head_gain=0.01)
        self.critic = _orthogonal(mlp(observation_size, 1, hidden), head_gain=1.0)
        self.log_std = None if self.discrete else nn.Parameter(torch.zeros(size))

    def distribution(self, normalised: Tensor) -> DiagonalGaussian | CategoricalActions:
        """The action distribution given normalised observations ``(*batch, observation_size)``."""
        out = self.actor(normalised)
        if self.log_std is None:
            return CategoricalActions(out)
        return DiagonalGaussian(out, self.log_std)

    def act(self, observation: Tensor, *, greedy: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """An action, its log-probability and the normalised observation, ``(*batch, ...)`` each.

        Args:
            observation: raw observations ``(*batch, observation_size)``, where the weights are.
            greedy: takes the most likely action rather than a draw.
        """
        normalised = self.normaliser(observation)
        distribution = self.distribution(normalised)
        action = distribution.mode if greedy else distribution.sample()
        return action, distribution.log_prob(action), normalised

    def update_normaliser(self, observation: Tensor) -> None:
        """Merges raw observations into the running statistics, if there are any."""
        if isinstance(self.normaliser, RunningNormaliser):
            self.normaliser.update(observation)

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return next(self.critic.parameters()).device

    def value_network(self) -> TensorDictModule:
        """What advantages have the values computed by, in a batch and where it leads to."""
        return self.critic_for_loss()

    def prepare(self, batch: TensorDictBase, following: Tensor) -> None:
        """Writes into ``batch`` what :meth:`value_network` reads of where each step leads to.

        Args:
            batch: what the acting policy collected, ``(num_envs, time)``.
            following: the observation that follows each step.
        """
        batch.set(("next", NORMALISED), self.normaliser(following))

    def acting(self) -> ActingPolicy:
        """The module that acts in an environment; shares this one's parameters."""
        return ActingPolicy(self)

    def actor_for_loss(self) -> LossActor:
        """The module that gives :class:`torchrl.objectives.ClipPPOLoss` its distribution."""
        return LossActor(self)

    def critic_for_loss(self) -> TensorDictModule:
        """The value network on normalised observations, writing ``"state_value"``."""
        return TensorDictModule(self.critic, in_keys=[NORMALISED], out_keys=["state_value"])


class LossActor(TensorDictModuleBase):
    """Gives the action distribution for normalised observations."""

    def __init__(self, agent: ActorCritic) -> None:
        super().__init__()
        self.in_keys = [NORMALISED]
        self.out_keys = ["action"]
        self.agent = agent

    def get_dist(self, tensordict: TensorDictBase) -> DiagonalGaussian | CategoricalActions:
        """The distribution that the loss evaluates the recorded actions under."""
        return self.agent.distribution(tensordict.get(NORMALISED))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the distribution's mode as the action."""
        return tensordict.set("action", self.get_dist(tensordict).mode)


def _orthogonal(network: nn.Sequential, *, head_gain: float) -> nn.Sequential:
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    for layer in layers:
        gain = head_gain if layer is layers[-1] else math.sqrt(2)
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return network
