"""PPO's agent for frames: one convolutional trunk under policy and value."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Categorical, OneHot, TensorSpec

from giril_rl.errors import UserError
from giril_rl.networks.action_bounds import single_action_spec
from giril_rl.networks.distributions import CategoricalActions, OneHotActions
from giril_rl.networks.pixels import flat_frames
from giril_rl.networks.space_to_depth import SpaceToDepthConv, deal
from giril_rl.policies.actor_critic import LossActor, PPOAgent, orthogonal
from giril_rl.runs.pretrained import remembered

HIDDEN = "hidden"
DEALT = "dealt"
STRIDE = 4


class PixelActorCritic(PPOAgent):
    """Three convolutions and a layer of 512 units under a categorical policy and a value.

    8x8 of stride 4 to 32 channels, 4x4 of stride 2 to 64, 3x3 to 32, then 512, each with ReLU, on
    frames divided by 255 (the released code's policy). Weights are initialised orthogonally with
    gain sqrt(2), 0.01 for the policy's last layer and 1 for the value's.

    In PPO's loss the actor leaves the trunk's output as ``"hidden"`` for the critic, so that the
    trunk runs once.

    Args:
        actions: the environment's action spec, a :class:`torchrl.data.Categorical` or OneHot, whose
            encoding actions have; or a number of actions, which then are integers.
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
    input_keys = (DEALT,)
    actor: PixelActor
    critic: nn.Linear

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
        self.action_size = int(spec.space.n)
        self.actor = PixelActor(self.action_size, channels)
        self.critic = orthogonal(nn.Linear(512, 1), last=1.0)

    def hidden(self, observation: Tensor) -> Tensor:
        """The trunk's output ``(*batch, 512)`` for uint8 frames ``(*batch, channels, 84, 84)``."""
        return self.actor.hidden(observation)

    def distribution_and_value(self, observation: Tensor) -> tuple[CategoricalActions, Tensor]:
        """The action distribution and the value ``(*batch, 1)`` of uint8 frames."""
        hidden = self.hidden(observation)
        return self.distribution_of(hidden), self.critic(hidden)

    def distribution_of(self, hidden: Tensor) -> CategoricalActions:
        """The action distribution for the trunk's output ``(*batch, 512)``."""
        logits = self.actor.head(hidden)
        return OneHotActions(logits) if self.one_hot else CategoricalActions(logits)

    def act(self, observation: Tensor, *, greedy: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """An action, its log-probability ``(*batch)`` and the value ``(*batch, 1)``.

        Args:
            observation: uint8 frames ``(*batch, channels, 84, 84)``, where the weights are.
            greedy: takes the most likely action instead of sampling.
        """
        distribution, value = self.distribution_and_value(observation)
        action = distribution.mode if greedy else distribution.sample()
        return action, distribution.log_prob(action), value

    @torch.no_grad()
    def log_prob(self, observation: Tensor, action: Tensor) -> Tensor:
        """Log-probability ``(*batch,)`` of actions of any policy, for uint8 frames."""
        return self.distribution_of(self.hidden(observation)).log_prob(action)

    @torch.no_grad()
    def prepare(self, batch: TensorDictBase, following: Tensor) -> None:
        """Writes the value of each next observation, and the frames as the loss reads them.

        The next value is mostly that of the next step, which the acting policy has computed.

        Args:
            batch: from the acting policy, ``(num_envs, time)``, with ``"state_value"``.
            following: the next observation of each step, uint8 ``(num_envs, time, ...)``.
        """
        value = batch.get("state_value")
        after = value.roll(-1, 1)
        alone = batch.get(("next", "done")).squeeze(-1).clone()
        alone[:, -1] = True
        after[alone] = self.critic(self.hidden(following[alone]))
        batch.set(("next", "state_value"), after)
        batch.set(DEALT, self.actor.deal(batch.get("observation")))

    def loss_distribution(self, minibatch: TensorDictBase) -> CategoricalActions:
        """The action distribution for ``"dealt"`` frames; writes ``"hidden"`` for the critic.

        In the loss, ``minibatch`` is the loss's own shallow copy.
        """
        hidden = self.actor.hidden_of_dealt(minibatch.get(DEALT))
        minibatch.set(HIDDEN, hidden)
        return self.distribution_of(hidden)

    def actor_for_loss(self) -> LossActor:
        """The module that gives :class:`torchrl.objectives.ClipPPOLoss` its distribution."""
        return LossActor(self, out_keys=[HIDDEN])

    def critic_for_loss(self) -> TensorDictModule:
        """The critic on the ``"hidden"`` that the actor left, writing ``"state_value"``."""
        return TensorDictModule(self.critic, in_keys=[HIDDEN], out_keys=["state_value"])


class PixelActor(nn.Module):
    """The trunk and the policy's last layer: uint8 frames to logits. Behaviour cloning fits it.

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
        orthogonal(self, last=0.01)

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
