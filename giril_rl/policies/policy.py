"""The policy and value network of PPO, as the collector, the loss and the evaluation see them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Categorical, OneHot, TensorSpec

from giril_rl.networks.action_bounds import ActionBounds, single_action_spec
from giril_rl.networks.distributions import CategoricalActions, DiagonalGaussian, OneHotActions
from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.networks.vectors import mlp
from giril_rl.policies.acting import ActingPolicy
from giril_rl.runs.pretrained import Pretrained, remembered

NORMALISED = "normalised"
DRAWN = "drawn_action"
"""What the Gaussian drew, neither scaled nor clamped: its log-probability is the recorded one."""


class ActorCritic(Pretrained, nn.Module):
    """Separate policy and value networks over one running observation normalisation.

    Gaussian actions with a standard deviation that does not depend on the state (first 1), or
    categorical ones. Orthogonal initialisation with gain sqrt(2), the policy's head 0.01, the
    value's 1.

    Actions have the encoding of their spec: integers for a Categorical, one-hot vectors for a
    OneHot. A policy cannot see which of the two its environment expects: give it that one's spec,
    or look with :func:`~giril_rl.policies.agents.fits`.

    The Gaussian is in units in which the bounds are -1 and 1, see
    :class:`~giril_rl.networks.action_bounds.ActionBounds`. ``"action"`` is in the environment's
    units and within the bounds; where there are any, the draw itself is written as
    ``"drawn_action"``, and the log-probability and PPO's loss are of that.

    Args:
        observation_size: size of the observation vector.
        action_spec: the environment's action spec: a :class:`torchrl.data.Categorical`, OneHot, or
            one-dimensional Bounded or Unbounded of real numbers.
        hidden: hidden layers of either network (tanh); the paper uses two of 100.
        normalise: whether observations are normalised with running statistics.

    Raises:
        UserError: for an action spec of another kind.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> agent = ActorCritic(4, Categorical(2, shape=(1,)))
        >>> policy = agent.acting()
        >>> policy(TensorDict({"observation": torch.zeros(3, 4)}, [3]))["action"].shape
        torch.Size([3])
        >>> from torchrl.data import Bounded
        >>> policy = ActorCritic(4, Bounded(-0.5, 0.5, shape=(1,))).acting()
        >>> acted = policy(TensorDict({"observation": torch.zeros(100, 4)}, [100]))
        >>> acted["action"].abs().max(), bool(acted["drawn_action"].abs().max() > 1)
        (tensor(0.5000), True)
    """

    acting_keys: tuple[str, ...] = ("action", "action_log_prob", NORMALISED)
    """What :meth:`act` returns, as the acting policy writes it."""
    readable_formats = (1, 2)
    drawn_key = "action"
    """Which of these has the recorded log-probability, for PPO's loss."""
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
        action_spec = single_action_spec(action_spec)
        self.one_hot = isinstance(action_spec, OneHot)
        self.discrete = isinstance(action_spec, (Categorical, OneHot))
        self.bounds = ActionBounds.of(action_spec)
        if self.bounds is not None:
            self.acting_keys, self.drawn_key = (*self.acting_keys, DRAWN), DRAWN
        size = action_spec.space.n if self.discrete else action_spec.shape[-1]
        self.normaliser = RunningNormaliser(observation_size) if normalise else nn.Identity()
        self.actor = _orthogonal(mlp(observation_size, size, hidden), head_gain=0.01)
        self.critic = _orthogonal(mlp(observation_size, 1, hidden), head_gain=1.0)
        self.log_std = None if self.discrete else nn.Parameter(torch.zeros(size))

    def distribution(self, normalised: Tensor) -> DiagonalGaussian | CategoricalActions:
        """The action distribution given normalised observations ``(*batch, observation_size)``."""
        out = self.actor(normalised)
        if self.log_std is None:
            return OneHotActions(out) if self.one_hot else CategoricalActions(out)
        return DiagonalGaussian(out, self.log_std)

    def executed(self, drawn: Tensor) -> Tensor:
        """The action that the environment is given for what the distribution drew."""
        return drawn if self.bounds is None else self.bounds(drawn)

    def act(self, observation: Tensor, *, greedy: bool = False) -> tuple[Tensor, ...]:
        """An action, its log-probability and the normalised observation, ``(*batch, ...)`` each.

        Where actions have bounds, a fourth entry is what was drawn.

        Args:
            observation: raw observations ``(*batch, observation_size)``, where the weights are.
            greedy: takes the most likely action rather than a draw.
        """
        normalised = self.normaliser(observation)
        distribution = self.distribution(normalised)
        drawn = distribution.mode if greedy else distribution.sample()
        acted = (self.executed(drawn), distribution.log_prob(drawn), normalised)
        return acted if self.bounds is None else (*acted, drawn)

    def update_normaliser(self, observation: Tensor) -> None:
        """Merges raw observations into the running statistics, if there are any."""
        if isinstance(self.normaliser, RunningNormaliser):
            self.normaliser.update(observation)

    @property
    def card_format(self) -> int:
        """2 where actions are scaled to bounds; 1 had them in the environment's units."""
        return 2 if self.bounds is not None and self.bounds.scales else 1

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
    """Gives the action distribution for normalised observations.

    ``dist_sample_keys`` and ``log_prob_keys`` tell TorchRL's losses what the distribution is of.
    """

    def __init__(self, agent: ActorCritic) -> None:
        super().__init__()
        self.in_keys = [NORMALISED]
        self.out_keys = ["action"]
        self.dist_sample_keys = [agent.drawn_key]
        self.log_prob_keys = ["action_log_prob"]
        self.agent = agent

    def get_dist(self, tensordict: TensorDictBase) -> DiagonalGaussian | CategoricalActions:
        """The distribution that the loss evaluates the recorded draws under."""
        return self.agent.distribution(tensordict.get(NORMALISED))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of the distribution's mode."""
        return tensordict.set("action", self.agent.executed(self.get_dist(tensordict).mode))


def _orthogonal(network: nn.Sequential, *, head_gain: float) -> nn.Sequential:
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    for layer in layers:
        gain = head_gain if layer is layers[-1] else math.sqrt(2)
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return network
