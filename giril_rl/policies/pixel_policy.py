"""PPO's policy and value network for pixels, one trunk under both heads."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Categorical, OneHot, TensorSpec

from giril_rl.errors import UserError
from giril_rl.networks.action_bounds import single_action_spec
from giril_rl.networks.distributions import CategoricalActions, OneHotActions
from giril_rl.networks.pixels import flat_frames
from giril_rl.networks.space_to_depth import SpaceToDepthConv, deal
from giril_rl.policies.acting import ActingPolicy
from giril_rl.runs.pretrained import Pretrained, remembered

HIDDEN = "hidden"
DEALT = "dealt"
STRIDE = 4


class PixelActorCritic(Pretrained, nn.Module):
    """Three convolutions and a layer of 512 under a categorical policy and a value.

    8x8 of stride 4 to 32 channels, 4x4 of stride 2 to 64, 3x3 to 32, then 512, each with ReLU, on
    frames divided by 255 (the released code's policy). Orthogonal initialisation with gain
    sqrt(2), the policy's head 0.01, the value's 1.

    The interface is that of :class:`~giril_rl.policies.policy.ActorCritic`. In PPO's loss the actor
    leaves the trunk's output as ``"hidden"`` for the critic, so that the trunk runs once.

    Args:
        actions: the environment's action spec, a :class:`torchrl.data.Categorical` or OneHot, of
            which actions have the encoding; or a number of actions, which then are integers.
        channels: frames in an observation.

    Raises:
        UserError: for an action spec of another kind.

    Examples:
        >>> from tensordict import TensorDict
        >>> agent = PixelActorCritic(6)
        >>> frames = torch.zeros(3, 4, 84, 84, dtype=torch.uint8)
        >>> agent.acting()(TensorDict({"observation": frames}, [3]))["action"].shape
        torch.Size([3])
    """

    discrete = True
    log_std = None
    bounds = None
    acting_keys = ("action", "action_log_prob", "state_value")
    drawn_key = "action"
    input_keys: tuple[str, ...] = (DEALT,)
    """What the networks in PPO's loss read of a minibatch."""

    @remembered
    def __init__(self, actions: int | TensorSpec, channels: int = 4) -> None:
        super().__init__()
        spec = Categorical(actions) if isinstance(actions, int) else single_action_spec(actions)
        if not isinstance(spec, (Categorical, OneHot)):
            raise UserError(
                "a policy of frames has discrete actions: give it a Categorical or OneHot spec, or "
                "their number."
            )
        self.one_hot = isinstance(spec, OneHot)
        self.normaliser = nn.Identity()
        self.actor = PixelActor(int(spec.space.n), channels)
        self.critic = nn.Linear(512, 1)
        _orthogonal(self.critic, 1.0)

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return self.critic.weight.device

    def hidden(self, observation: Tensor) -> Tensor:
        """The trunk's output ``(*batch, 512)`` for uint8 frames ``(*batch, channels, 84, 84)``."""
        return self.actor.hidden(observation)

    def distribution_and_value(self, observation: Tensor) -> tuple[CategoricalActions, Tensor]:
        """The action distribution and the value ``(*batch, 1)`` of uint8 frames, trunk run once."""
        hidden = self.hidden(observation)
        return self.distribution_of(hidden), self.critic(hidden)

    def distribution_of(self, hidden: Tensor) -> CategoricalActions:
        """The action distribution given the trunk's output ``(*batch, 512)``."""
        logits = self.actor.head(hidden)
        return OneHotActions(logits) if self.one_hot else CategoricalActions(logits)

    def value_network(self) -> None:
        """None: the acting policy has written the values, and :meth:`prepare` the next ones."""

    @torch.no_grad()
    def prepare(self, batch: TensorDictBase, following: Tensor) -> None:
        """Writes the value of what follows each step, which mostly is that of the next one.

        And the frames as the networks in PPO's loss take them, which all epochs share.

        Args:
            batch: what the acting policy collected, ``(num_envs, time)``, with ``"state_value"``.
            following: the observation that follows each step, uint8 ``(num_envs, time, ...)``.
        """
        value = batch.get("state_value")
        after = value.roll(-1, 1)
        alone = batch.get(("next", "done")).squeeze(-1).clone()
        alone[:, -1] = True
        after[alone] = self.critic(self.hidden(following[alone]))
        batch.set(("next", "state_value"), after)
        batch.set(DEALT, self.actor.deal(batch.get("observation")))

    def update_normaliser(self, observation: Tensor) -> None:
        """Does nothing: frames are divided by a constant."""

    def act(self, observation: Tensor, *, greedy: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """An action, its log-probability ``(*batch)`` and the value ``(*batch, 1)``.

        Args:
            observation: uint8 frames ``(*batch, channels, 84, 84)``, where the weights are.
            greedy: takes the most likely action rather than a draw.
        """
        distribution, value = self.distribution_and_value(observation)
        action = distribution.mode if greedy else distribution.sample()
        return action, distribution.log_prob(action), value

    def acting(self) -> ActingPolicy:
        """The module that acts in an environment; shares this one's parameters."""
        return ActingPolicy(self)

    def actor_for_loss(self) -> PixelLossActor:
        """The module that gives :class:`torchrl.objectives.ClipPPOLoss` its distribution."""
        return PixelLossActor(self)

    def critic_for_loss(self) -> TensorDictModule:
        """The value's head on what :meth:`actor_for_loss` left, writing ``"state_value"``."""
        return TensorDictModule(self.critic, in_keys=[HIDDEN], out_keys=["state_value"])


class PixelActor(nn.Module):
    """The trunk and the policy's head: uint8 frames to logits, what behaviour cloning fits.

    Args:
        actions: number of actions.
        channels: frames in an observation.

    Examples:
        >>> PixelActor(6)(torch.zeros(3, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([3, 6])
    """

    def __init__(self, actions: int, channels: int = 4) -> None:
        super().__init__()
        self.channels = channels
        self.trunk = nn.Sequential(
            SpaceToDepthConv(channels, 32, 8, stride=STRIDE),
            nn.ReLU(),
            nn.Conv2d(32, 64, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(64, 32, 3),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(32 * 7 * 7, 512),
            nn.ReLU(),
        )
        self.head = nn.Linear(512, actions)
        for layer in self.trunk:
            if isinstance(layer, (nn.Conv2d, nn.Linear)):
                _orthogonal(layer, math.sqrt(2))
        _orthogonal(self.head, 0.01)

    def deal(self, observation: Tensor) -> Tensor:
        """Frames ``(*batch, channels, 84, 84)`` as the trunk takes them, see :func:`deal`."""
        dealt = deal(flat_frames(observation, self.channels), STRIDE)
        return dealt.reshape(*observation.shape[:-3], *dealt.shape[1:])

    def hidden(self, observation: Tensor) -> Tensor:
        """The trunk's output ``(*batch, 512)`` for uint8 frames ``(*batch, channels, 84, 84)``."""
        return self.hidden_of_dealt(self.deal(observation))

    def hidden_of_dealt(self, dealt: Tensor) -> Tensor:
        """The same for what :meth:`deal` returned."""
        return self.trunk(dealt.reshape(-1, *dealt.shape[-3:])).reshape(*dealt.shape[:-3], 512)

    def forward(self, observation: Tensor) -> Tensor:
        """The logits ``(*batch, actions)``."""
        return self.head(self.hidden(observation))


class PixelLossActor(TensorDictModuleBase):
    """Gives the action distribution, and leaves the trunk's output for the critic."""

    def __init__(self, agent: PixelActorCritic) -> None:
        super().__init__()
        self.in_keys = [DEALT]
        self.out_keys = ["action", HIDDEN]
        self.dist_sample_keys = [agent.drawn_key]
        self.log_prob_keys = ["action_log_prob"]
        self.agent = agent

    def get_dist(self, tensordict: TensorDictBase) -> CategoricalActions:
        """The distribution that the loss evaluates the recorded actions under.

        Writes ``"hidden"`` into ``tensordict``, which in the loss is its own shallow copy of the
        minibatch, the one that the critic gets next.
        """
        hidden = self.agent.actor.hidden_of_dealt(tensordict.get(DEALT))
        tensordict.set(HIDDEN, hidden)
        return self.agent.distribution_of(hidden)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the distribution's mode as the action."""
        return tensordict.set("action", self.get_dist(tensordict).mode)


def _orthogonal(layer: nn.Conv2d | nn.Linear, gain: float) -> None:
    nn.init.orthogonal_(layer.weight, gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
