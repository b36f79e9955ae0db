"""SAC's agent: an actor whose actions are squashed to the bounds, and the critics that it needs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Categorical, OneHot, TensorSpec
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
from torchrl.modules.distributions import OneHotCategorical

from giril_rl.errors import UserError
from giril_rl.networks.action_bounds import ActionBounds, single_action_spec
from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.networks.precision import Precision, in_precision
from giril_rl.policies.agent import Agent
from giril_rl.runs.pretrained import remembered

DRAWN = "drawn_action"
"""An action in units in which the bounds are -1 and 1; critics and losses see these."""
ELAPSED = "elapsed"
"""``gamma ** t`` after t steps of an episode: 1 where it begins, and hardly more than 0 later."""
_EDGE = 1 - 1e-6
"""Largest squashed action whose log-density is finite in float32."""


class SACAgent(Agent):
    """A tanh-squashed Gaussian for bounded vectors, or a categorical distribution.

    ReLU networks. The Gaussian is in units in which the bounds are -1 and 1, see
    :class:`~giril_rl.networks.action_bounds.ActionBounds`, and never leaves them. Critics are not
    part of the agent: :meth:`critic` makes them for the loss that trains them.

    Args:
        observation_size: size of the observation vector.
        action_spec: the environment's action spec: a :class:`torchrl.data.Categorical`, OneHot, or
            one-dimensional Bounded with two finite bounds for each number.
        hidden: hidden layers of actor and critics.
        normalise: whether observations are normalised with running statistics.
        noise: standard deviation before squashing; None lets the network choose it for each state.
        precision: "fp32", or "bf16" for products in bfloat16 between hidden layers.

    Raises:
        UserError: for an action spec of another kind, or an unknown precision.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> policy = SACAgent(4, Bounded(-0.5, 0.5, shape=(2,))).acting()
        >>> acted = policy(TensorDict({"observation": torch.randn(100, 4)}, [100]))
        >>> acted["action"].shape, bool(acted["action"].abs().max() < 0.5)
        (torch.Size([100, 2]), True)
    """

    acting_keys: tuple[str, ...] = ("action",)
    samples_to_explore = True

    @remembered
    def __init__(
        self,
        observation_size: int,
        action_spec: TensorSpec,
        *,
        hidden: Sequence[int] = (128, 128),
        normalise: bool = False,
        noise: float | None = None,
        precision: Precision = "fp32",
    ) -> None:
        super().__init__()
        spec = check_squashable(action_spec)
        self.one_hot = isinstance(spec, OneHot)
        self.discrete = isinstance(spec, (Categorical, OneHot))
        self.bounds = ActionBounds.of(spec)
        self.observation_size, self.hidden = observation_size, list(hidden)
        self.precision: Precision = precision
        self.action_size = int(spec.space.n if self.discrete else spec.shape[-1])
        self.normaliser = RunningNormaliser(observation_size) if normalise else nn.Identity()
        head: list[nn.Module] = []
        outputs = self.action_size
        if not self.discrete:
            head = [_Scale() if noise is None else _FixedScale(noise)]
            outputs *= 1 if noise is not None else 2
        self.actor = nn.Sequential(self._mlp(observation_size, outputs), *head)

    def _mlp(self, inputs: int, outputs: int) -> MLP:
        network = MLP(inputs, outputs, num_cells=self.hidden, activation_class=nn.ReLU)
        in_precision(network, self.precision)
        return network

    def normalised(self, observation: Tensor) -> Tensor:
        """Raw observations ``(*batch, observation_size)`` as actor and critics see them."""
        return self.normaliser(observation.to(torch.get_default_dtype()))

    def distribution(self, normalised: Tensor) -> TanhNormal | OneHotCategorical:
        """The distribution of drawn actions for normalised observations."""
        if self.discrete:
            return OneHotCategorical(logits=self.actor(normalised), validate_args=False)
        return TanhNormal(*self.actor(normalised))

    def act(self, observation: Tensor, *, greedy: bool = False) -> tuple[Tensor, ...]:
        """An action ``(*batch, ...)`` in the environment's units.

        Args:
            observation: raw observations ``(*batch, observation_size)``, where the weights are.
            greedy: takes the squashed mean, or the most likely action, instead of sampling.
        """
        if self.discrete:
            logits = self.actor(self.normalised(observation))
            noise = torch.zeros_like(logits) if greedy else torch.empty_like(logits).exponential_()
            index = (logits - (noise if greedy else noise.log())).argmax(-1)
            return (self._encoded(index),)
        location, scale = self.actor(self.normalised(observation))
        drawn = location if greedy else torch.addcmul(location, torch.randn_like(scale), scale)
        return (self.executed(drawn.tanh()),)

    def executed(self, drawn: Tensor) -> Tensor:
        """The environment's action for a drawn one."""
        return drawn if self.bounds is None else self.bounds(drawn)

    def drawn(self, action: Tensor) -> Tensor:
        """The inverse of :meth:`executed`; an action on or beyond the bounds is put within."""
        if self.bounds is None:
            return action
        return self.bounds.inverse(action).clamp(-_EDGE, _EDGE)

    def random(self, count: int) -> Tensor:
        """``count`` uniformly random actions in the environment's units."""
        if self.discrete:
            return self._encoded(torch.randint(self.action_size, (count,)))
        return self.executed(torch.rand(count, self.action_size).to(self.device) * 2 - 1)

    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Log-probability ``(*batch,)`` of actions in the environment's units.

        Of a Box it is the density of the action scaled to [-1, 1].

        Args:
            observation: raw observations ``(*batch, observation_size)``.
            action: as the environment has them.
        """
        distribution = self.distribution(self.normalised(observation))
        if self.discrete:
            index = action.long().argmax(-1) if self.one_hot else action.long()
            return distribution.logits.gather(-1, index.unsqueeze(-1)).squeeze(-1)
        return distribution.log_prob(self.drawn(action))

    def imitation_loss(self, observation: Tensor, action: Tensor) -> Tensor:
        """What behaviour cloning minimises, of each demonstrated pair, ``(*batch,)``.

        Cross-entropy, or the squared error of the squashed mean action in units in which the bounds
        are -1 and 1, averaged over its dimensions.

        Args:
            observation: raw observations ``(*batch, observation_size)``.
            action: as the environment has them.
        """
        if self.discrete:
            return -self.log_prob(observation, action)
        location, _ = self.actor(self.normalised(observation))
        return (location.tanh() - self.drawn(action)).square().mean(-1)

    def update_normaliser(self, observation: Tensor) -> None:
        """Merges raw observations into the running statistics, if there are any."""
        if isinstance(self.normaliser, RunningNormaliser):
            self.normaliser.update(observation)

    def actor_for_loss(self) -> ProbabilisticActor:
        """The actor on normalised observations as TorchRL's losses want it."""
        if self.discrete:
            names, kind = ["logits"], OneHotCategorical
        else:
            names, kind = ["loc", "scale"], TanhNormal
        return ProbabilisticActor(
            TensorDictModule(self.actor, in_keys=["observation"], out_keys=names),
            in_keys=names,
            out_keys=["action" if self.discrete else DRAWN],
            distribution_class=kind,
            distribution_kwargs={"validate_args": False} if self.discrete else {},
            return_log_prob=True,
        )

    def critic(self, *, time_aware: bool = False) -> TensorDictModule:
        """A new critic: of observation and drawn action, or of every discrete action.

        Args:
            time_aware: whether it also reads :data:`ELAPSED`, ``(*batch, 1)``.
        """
        seen = ["observation", *([ELAPSED] if time_aware else [])]
        size = self.observation_size + time_aware
        if self.discrete:
            network = self._mlp(size, self.action_size)
            return TensorDictModule(network, in_keys=seen, out_keys=["action_value"])
        return TensorDictModule(
            self._mlp(size + self.action_size, 1),
            in_keys=[*seen, DRAWN],
            out_keys=["state_action_value"],
        )

    def _encoded(self, index: Tensor) -> Tensor:
        if not self.one_hot:
            return index
        zeros = torch.zeros(*index.shape, self.action_size, dtype=torch.int64, device=index.device)
        return zeros.scatter(-1, index.unsqueeze(-1), 1)


class _Scale(nn.Module):
    """Mean and standard deviation, the latter between e^-20 and e^2 as is usual for SAC."""

    def forward(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        location, log_scale = outputs.chunk(2, -1)
        return location, log_scale.clamp(-20, 2).exp()


class _FixedScale(nn.Module):
    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = scale

    def forward(self, location: Tensor) -> tuple[Tensor, Tensor]:
        return location, torch.full_like(location, self.scale)


def check_squashable(spec: TensorSpec) -> TensorSpec:
    """The single action spec, if SAC has a form for it.

    Raises:
        UserError: for a Box without two finite bounds for each number, and other kinds of actions.

    Examples:
        >>> from torchrl.data import Unbounded
        >>> check_squashable(Unbounded((2,)))
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: SAC squashes actions to their bounds, and this action space has
        none: give the environment finite bounds (gymnasium's RescaleAction), or set algorithm=ppo.
    """
    spec = single_action_spec(spec)
    if isinstance(spec, (Categorical, OneHot)):
        return spec
    bounds = ActionBounds.of(spec)
    if bounds is None or not (bounds.low.isfinite() & bounds.high.isfinite()).all():
        raise UserError(
            "SAC squashes actions to their bounds, and this action space has none: give the "
            "environment finite bounds (gymnasium's RescaleAction), or set algorithm=ppo."
        )
    return spec
