"""PPO's agents: what its loss needs of them, and the one for observation vectors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Categorical, OneHot, TensorSpec

from giril_rl.networks.action_bounds import ActionBounds, single_action_spec
from giril_rl.networks.distributions import CategoricalActions, DiagonalGaussian, OneHotActions
from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.networks.vectors import mlp
from giril_rl.policies.agent import Agent
from giril_rl.runs.pretrained import remembered

NORMALISED = "normalised"
DRAWN = "drawn_action"
"""The Gaussian's sample, before scaling and clamping. The recorded log-probability is of it."""

Distribution = DiagonalGaussian | CategoricalActions
Network = TypeVar("Network", bound=nn.Module)


class PPOAgent(Agent):
    """An agent that PPO trains: an actor and a critic of the state value."""

    actor: nn.Module
    critic: nn.Module
    normaliser: nn.Module
    discrete: bool
    one_hot: bool
    action_size: int
    log_std: nn.Parameter | None
    bounds: ActionBounds | None
    drawn_key: str = "action"
    """Which of the ``acting_keys`` the recorded log-probability is of."""
    input_keys: tuple[str, ...]
    """What the networks in PPO's loss read of a minibatch."""

    def executed(self, drawn: Tensor) -> Tensor:
        """The environment's action for a sample of the distribution."""
        return drawn if self.bounds is None else self.bounds(drawn)

    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Log-probability ``(*batch,)`` of an environment's actions, without gradient.

        Args:
            observation: raw observations ``(*batch, ...)``, where the weights are.
            action: actions as the environment takes them, of any policy.
        """
        raise NotImplementedError

    def prepare(self, batch: TensorDictBase, following: Tensor) -> None:
        """Writes into a collected batch what the advantages and the loss read.

        Args:
            batch: from the acting policy, ``(num_envs, time)``.
            following: the next observation of each step.
        """
        raise NotImplementedError

    def loss_distribution(self, minibatch: TensorDictBase) -> Distribution:
        """The action distribution that PPO's loss evaluates the recorded samples under."""
        raise NotImplementedError

    def value_network(self) -> TensorDictModule | None:
        """What computes the values for the advantages; None if :meth:`prepare` writes them."""
        return None

    def imitation_loss(self, observation: Tensor, action: Tensor) -> Tensor:
        """What behaviour cloning minimises, of each demonstrated pair, ``(*batch,)``.

        Cross-entropy, or the squared error of the mean action in units in which the bounds are -1
        and 1, averaged over its dimensions.

        Args:
            observation: raw observations ``(*batch, ...)``.
            action: as the environment has them.
        """
        out = self.actor(self.normaliser(observation))
        if not self.discrete:
            target = action if self.bounds is None else self.bounds.inverse(action)
            return (out - target).square().mean(-1)
        index = action.long().argmax(-1) if self.one_hot else action.long()
        return -out.log_softmax(-1).gather(-1, index.unsqueeze(-1)).squeeze(-1)

    def actor_for_loss(self) -> LossActor:
        """The module that gives :class:`torchrl.objectives.ClipPPOLoss` its distribution."""
        return LossActor(self)

    def critic_for_loss(self) -> TensorDictModule:
        """The module that writes ``"state_value"`` in PPO's loss."""
        raise NotImplementedError


class LossActor(TensorDictModuleBase):
    """An agent's action distribution as TorchRL's losses want it.

    Args:
        agent: gives the distribution.
        out_keys: entries of the minibatch that the agent writes meanwhile.
    """

    def __init__(self, agent: PPOAgent, out_keys: Sequence[str] = ()) -> None:
        super().__init__()
        self.in_keys = list(agent.input_keys)
        self.out_keys = ["action", *out_keys]
        self.dist_sample_keys = [agent.drawn_key]
        self.log_prob_keys = ["action_log_prob"]
        self.agent = agent

    def get_dist(self, tensordict: TensorDictBase) -> Distribution:
        """The distribution, see :meth:`PPOAgent.loss_distribution`."""
        return self.agent.loss_distribution(tensordict)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of the distribution's mode."""
        return tensordict.set("action", self.agent.executed(self.get_dist(tensordict).mode))


class ActorCritic(PPOAgent):
    """Separate policy and value networks for vectors, over one running normalisation.

    Actions are Gaussian with a standard deviation that does not depend on the state (at first 1),
    or categorical. Weights are initialised orthogonally with gain sqrt(2), 0.01 for the policy's
    last layer and 1 for the value's.

    Actions have the encoding of their spec: integers for a Categorical, one-hot vectors for a
    OneHot. Give the environment's own spec, because a policy cannot see which of the two the
    environment expects; :func:`~giril_rl.policies.fits` checks it.

    The Gaussian is in units in which the bounds are -1 and 1, see
    :class:`~giril_rl.networks.action_bounds.ActionBounds`. ``"action"`` is in the environment's
    units and within the bounds. Where there are bounds, the sample itself is ``"drawn_action"``,
    and the log-probability and PPO's loss refer to it.

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
        >>> from torchrl.data import Bounded, Categorical
        >>> agent = ActorCritic(4, Categorical(2, shape=(1,)))
        >>> policy = agent.acting()
        >>> policy(TensorDict({"observation": torch.zeros(3, 4)}, [3]))["action"].shape
        torch.Size([3])
        >>> policy = ActorCritic(4, Bounded(-0.5, 0.5, shape=(1,))).acting()
        >>> acted = policy(TensorDict({"observation": torch.zeros(100, 4)}, [100]))
        >>> acted["action"].abs().max(), bool(acted["drawn_action"].abs().max() > 1)
        (tensor(0.5000), True)
    """

    acting_keys: tuple[str, ...] = ("action", "action_log_prob", NORMALISED)
    readable_formats = (1, 2)
    input_keys = (NORMALISED,)

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
        size = int(action_spec.space.n if self.discrete else action_spec.shape[-1])
        self.action_size = size
        self.normaliser = RunningNormaliser(observation_size) if normalise else nn.Identity()
        self.actor = orthogonal(mlp(observation_size, size, hidden), last=0.01)
        self.critic = orthogonal(mlp(observation_size, 1, hidden), last=1.0)
        self.log_std = None if self.discrete else nn.Parameter(torch.zeros(size))

    def distribution(self, normalised: Tensor) -> Distribution:
        """The action distribution for normalised observations ``(*batch, observation_size)``."""
        out = self.actor(normalised)
        if self.log_std is None:
            return OneHotActions(out) if self.one_hot else CategoricalActions(out)
        return DiagonalGaussian(out, self.log_std)

    def act(self, observation: Tensor, *, greedy: bool = False) -> tuple[Tensor, ...]:
        """An action, its log-probability and the normalised observation, ``(*batch, ...)`` each.

        Where actions have bounds, a fourth entry is the sample itself.

        Args:
            observation: raw observations ``(*batch, observation_size)``, where the weights are.
            greedy: takes the most likely action instead of sampling.
        """
        normalised = self.normaliser(observation)
        distribution = self.distribution(normalised)
        drawn = distribution.mode if greedy else distribution.sample()
        acted = (self.executed(drawn), distribution.log_prob(drawn), normalised)
        return acted if self.bounds is None else (*acted, drawn)

    @torch.no_grad()
    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Log-probability ``(*batch,)`` of actions as the environment takes them.

        A Gaussian's is a density in units in which the bounds are -1 and 1. At a bound it is the
        probability of all draws beyond, see
        :meth:`~giril_rl.networks.distributions.DiagonalGaussian.clamped_log_prob`: the density
        there would tell a policy far outside from one that plays the very same bound.

        Args:
            observation: raw observations ``(*batch, observation_size)``, where the weights are.
            action: of any policy, such as the demonstration's; clamped to the bounds.
        """
        distribution = self.distribution(self.normaliser(observation))
        bounds = self.bounds
        if bounds is None or not isinstance(distribution, DiagonalGaussian):
            return distribution.log_prob(action)
        low, high = action <= bounds.low, action >= bounds.high
        draw = bounds.inverse(torch.clamp(action, bounds.low, bounds.high))
        return distribution.clamped_log_prob(draw, low, high)

    def update_normaliser(self, observation: Tensor) -> None:
        """Merges raw observations into the running statistics, if there are any."""
        if isinstance(self.normaliser, RunningNormaliser):
            self.normaliser.update(observation)

    @property
    def card_format(self) -> int:
        """2 where actions are scaled to bounds; 1 had them in the environment's units."""
        return 2 if self.bounds is not None and self.bounds.scales else 1

    def prepare(self, batch: TensorDictBase, following: Tensor) -> None:
        """Writes the next observations, normalised."""
        batch.set(("next", NORMALISED), self.normaliser(following))

    def loss_distribution(self, minibatch: TensorDictBase) -> Distribution:
        """The action distribution for ``"normalised"``."""
        return self.distribution(minibatch.get(NORMALISED))

    def value_network(self) -> TensorDictModule:
        """The critic, as in the loss."""
        return self.critic_for_loss()

    def critic_for_loss(self) -> TensorDictModule:
        """The critic on ``"normalised"``, writing ``"state_value"``."""
        return TensorDictModule(self.critic, in_keys=[NORMALISED], out_keys=["state_value"])


def orthogonal(network: Network, *, last: float) -> Network:
    """Initialises a network orthogonally with gain sqrt(2), its last layer with gain ``last``."""
    layers = [x for x in network.modules() if isinstance(x, (nn.Linear, nn.Conv2d))]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, last if layer is layers[-1] else math.sqrt(2))
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)
    return network
