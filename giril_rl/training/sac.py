"""Soft actor-critic (Haarnoja et al., 2018) on TorchRL's SACLoss, replay buffer and SoftUpdate."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import DiscreteSACLoss, SACLoss, SoftUpdate
from torchrl.objectives.utils import ValueEstimators

from giril_rl.config.schema import SACConfig
from giril_rl.errors import UserError
from giril_rl.graphs.gradients import TracedGradients
from giril_rl.graphs.updates import CompiledUpdate
from giril_rl.policies.agent import ActingPolicy, collecting
from giril_rl.policies.soft_actor_critic import DRAWN, ELAPSED, SACAgent
from giril_rl.runs.randomness import seeded, stream_seed
from giril_rl.training.episodes import EpisodeClock, HeldEpisodes
from giril_rl.training.replay import Replay
from giril_rl.transforms.scaling import ReturnScaling

OBSERVATION, ACTION = "observation", "action"
NEXT, ONWARD = ("next", "observation"), ("next", "following_observation")
REWARD, TERMINATED = ("next", "reward"), ("next", "terminated")
DONE = ("next", "done")
STORED: tuple[NestedKey, ...] = (OBSERVATION, ACTION, NEXT, TERMINATED, ONWARD, ELAPSED)
"""What a minibatch has besides a stored reward; the last two only where there are hidden resets and
where critics see the time."""


class SAC:
    """An :class:`~giril_rl.training.algorithm.Algorithm`: learns from minibatches of a replay.

    A batch's reward is stored as the loop's transform wrote it. Where the reward model learns
    beside the policy, ``relabel`` computes it anew for each minibatch instead. The true reward is
    never stored.

    Args:
        agent: the policy, trained in place.
        cfg: settings of SAC.
        steps: environment steps of the whole training, rounded up to whole batches.
        seed: seed of the critics' weights.
        folder: where the replay buffer's files are; None keeps it in memory.
        demonstration: flat transitions with a reward, for ``cfg.demonstration``; None for none.
            With ``"elapsed"``, ``gamma ** t``, for ``cfg.time_aware_critic``.
        relabel: a transform that writes the reward into a flat minibatch; None takes the stored.
        relabel_episodes: writes the reward into whole episodes ``(1, length)``, which are stored
            once they have ended; None stores each batch.
        scaling: divides rewards by its running standard deviation as they are drawn; it learns from
            each batch. None does not scale.
        termination: "ends" or "bootstrap", see :class:`~giril_rl.training.ppo.PPO`.

    Raises:
        UserError: for another ``termination``.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> agent = SACAgent(3, Bounded(-1, 1, shape=(1,)))
        >>> cfg = SACConfig(num_envs=2, rollout=4, batch=8, random_steps=0, log_every=8)
        >>> sac = SAC(agent, cfg, steps=100, seed=0)
        >>> steps = [sac.act()(TensorDict({"observation": torch.randn(2, 3)}, [2])) for _ in "1234"]
        >>> batch = torch.stack(steps, 1)
        >>> flag = torch.zeros(2, 4, 1, dtype=torch.bool)
        >>> batch["next"] = TensorDict(
        ...     {
        ...         "observation": torch.randn(2, 4, 3),
        ...         "reward": torch.ones(2, 4, 1),
        ...         "done": flag,
        ...         "terminated": flag,
        ...     },
        ...     [2, 4],
        ... )
        >>> sorted(sac.update(batch))
        ['alpha', 'entropy', 'loss_actor', 'loss_alpha', 'loss_qvalue']
    """

    name = "sac"

    def __init__(
        self,
        agent: SACAgent,
        cfg: SACConfig,
        *,
        steps: int,
        seed: int = 0,
        folder: Path | None = None,
        demonstration: TensorDictBase | None = None,
        relabel: Callable[[TensorDictBase], TensorDictBase] | None = None,
        relabel_episodes: Callable[[TensorDictBase], TensorDictBase] | None = None,
        scaling: ReturnScaling | None = None,
        termination: str = "ends",
    ) -> None:
        if termination not in ("ends", "bootstrap"):
            raise UserError(f"termination={termination}: choose one of ends, bootstrap.")
        self.agent, self.cfg = agent, cfg
        self.num_envs, self.log_every = cfg.num_envs, cfg.log_every
        self.frames_per_batch = cfg.num_envs * cfg.rollout
        # Whole episodes come many transitions at a time.
        share = 4 if relabel_episodes is None else 1
        self._slack = max(cfg.buffer_size // share, 2 * self.frames_per_batch)
        self.checkpoint_every = min(cfg.checkpoint_every, self._slack - self.frames_per_batch)
        self.steps = cfg.whole_batches(steps)
        self.bootstraps_failure = termination == "bootstrap"
        self.relabel, self.scaling = relabel, scaling
        self.relabel_episodes = relabel_episodes
        self.held, self.clock = HeldEpisodes(), EpisodeClock()
        self._taken = self._updates = 0
        self._demonstration, self._folder = demonstration, folder
        self.replay: Replay | None = None
        with seeded(stream_seed("training", seed), agent.device):
            loss = _loss(agent, cfg)
        self.loss = loss
        inputs: list[NestedKey] = [OBSERVATION, ACTION if agent.discrete else DRAWN]
        times = [ELAPSED, ("next", ELAPSED)] if cfg.time_aware_critic else []
        self.keys = (*inputs, NEXT, REWARD, DONE, TERMINATED, *times)
        self.gradients = TracedGradients(
            loss, keys=self.keys, log=("alpha", "entropy"), compile=cfg.compile
        )
        self.optimizer = torch.optim.Adam(self.gradients.parameters, lr=cfg.lr, fused=True)
        self.targets = SoftUpdate(loss, tau=cfg.tau)
        self._step = self._gradient_step()

    def act(self) -> TensorDictModuleBase:
        """The policy that collects: it samples, at first uniformly from all actions."""
        return _Exploring(self, collecting(self.agent, compile=self.cfg.compile))

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Stores a batch ``(num_envs, time)`` and takes the gradient steps that are due.

        Returns:
            Means over these gradient steps; empty where none is due yet.
        """
        if self.scaling is not None:
            self.scaling.unfreeze()(batch)
            self.scaling.freeze()
        if self.cfg.time_aware_critic:
            elapsed = self.cfg.gamma ** self.clock(batch).unsqueeze(-1).float()
            batch = batch.clone(False).set(ELAPSED, elapsed)
        if self.relabel_episodes is None:
            self._store(batch.flatten(0, 1))
        else:
            kept = batch.select(*STORED, DONE, strict=False)
            for episode in self.held.add(kept):
                self._store(self.relabel_episodes(_without_reward(episode)).squeeze(0))
        self.agent.update_normaliser(batch.get(OBSERVATION))
        self._taken += batch.numel()
        due = int((self._taken - self.cfg.random_steps) * self.cfg.updates) - self._updates
        if due <= 0 or not self.replay:
            return {}
        self._updates += due
        logs = [self._step(minibatch) for minibatch in self._minibatches(due)]
        return {key: torch.stack([log[key] for log in logs]).mean().item() for key in logs[0]}

    def _store(self, flat: TensorDictBase) -> None:
        if self.replay is None:
            keys = [key for key in STORED if key in flat.keys(True)]
            self.replay = self._replay([*keys, REWARD] if self.relabel is None else keys)
        self.replay.extend(flat)

    def own(self, count: int) -> TensorDictBase | None:
        """Draws ``count`` of the agent's own transitions, for a reward that learns beside it.

        Args:
            count: how many, drawn uniformly with torch's global generator.

        Returns:
            A flat batch without rewards to learn from; None where nothing was stored yet.
        """
        if self.replay is None or not len(self.replay):
            return None
        return self.replay.own(count)

    def _gradient_step(self) -> Callable[[Sequence[Tensor]], dict[str, Tensor]]:
        if self.cfg.compile:
            return CompiledUpdate(self.gradients, self.optimizer, self.targets).step

        def step(minibatch: Sequence[Tensor]) -> dict[str, Tensor]:
            log = self.gradients.step(minibatch)
            self.optimizer.step()
            self.targets.step()
            return log

        return step

    @torch.no_grad()
    def _minibatches(self, count: int) -> Any:
        """``count`` minibatches as the loss reads them, drawn at once."""
        cfg, agent = self.cfg, self.agent
        assert self.replay is not None
        drawn = self.replay.sample(count * cfg.batch, minibatch=cfg.batch).to(agent.device)
        if self.relabel is not None:
            drawn = self.relabel(_without_reward(drawn))
        if self.scaling is not None:
            drawn = self.scaling(drawn)
        reward, terminated = drawn.get(REWARD), drawn.get(TERMINATED)
        if self.bootstraps_failure:
            terminated = torch.zeros_like(terminated)
        onward = drawn.get(ONWARD, None)
        columns = [
            agent.normalised(drawn.get(OBSERVATION)),
            agent.drawn(drawn.get(ACTION)),
            agent.normalised(drawn.get(NEXT) if onward is None else onward),
            reward,
            terminated,  # Takes the place of done, by which the loss does not look.
            terminated,
        ]
        if cfg.time_aware_critic:
            elapsed = drawn.get(ELAPSED)
            columns += elapsed, elapsed * cfg.gamma
        return zip(*(column.split(cfg.batch) for column in columns), strict=True)

    def _replay(self, keys: Sequence[NestedKey]) -> Replay:
        cfg, known = self.cfg, self._demonstration
        size = min(cfg.buffer_size, self.steps)
        slack = self._slack if size < self.steps else 0
        if known is not None and ONWARD in keys:
            known = known.clone(False).set(ONWARD, known.get(NEXT))
        return Replay(
            keys,
            size=size,
            slack=slack,
            folder=self._folder,
            demonstration=known,
            share=0.5 if cfg.demonstration == "half" else None,
        )

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimizer and counters, and what finds the replay buffer as it is now."""
        return {
            "agent": dict(self.agent.state_dict()),
            "loss": _tensors(self.loss),
            "optimizer": self.optimizer.state_dict(),
            "held": self.held.state_dict(),
            "clock": self.clock.state_dict() if self.cfg.time_aware_critic else None,
            "replay": None if self.replay is None else self.replay.state_dict(),
            "scaling": None if self.scaling is None else dict(self.scaling.state_dict()),
            "steps": self._taken,
            "updates": self._updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        self.agent.load_state_dict(state["agent"])
        with torch.no_grad():
            for name, tensor in _tensors(self.loss).items():
                tensor.copy_(state["loss"][name])
        self.optimizer.load_state_dict(state["optimizer"])
        self._step = self._gradient_step()
        if self.scaling is not None:
            self.scaling.load_state_dict(state["scaling"])
        self.held.load_state_dict(state["held"])
        if self.cfg.time_aware_critic:
            self.clock.load_state_dict(state["clock"])
        self._taken, self._updates = state["steps"], state["updates"]
        self.replay = None
        if state["replay"] is not None:
            self.replay = self._replay(Replay.keys_of(state["replay"]))
            self.replay.load_state_dict(state["replay"])

    def close(self) -> None:
        """Deletes the replay buffer, once training is over."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)


class _Exploring(TensorDictModuleBase):
    """A policy that draws uniformly from all actions until learning begins."""

    def __init__(self, sac: SAC, policy: ActingPolicy) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.policy = policy
        self._sac = (sac,)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        sac = self._sac[0]
        if sac._taken >= sac.cfg.random_steps:
            return self.policy(tensordict)
        seen = tensordict.get(OBSERVATION)
        return tensordict.set(ACTION, sac.agent.random(len(seen)).to(seen.device))


class _FixedTemperature:
    """A loss without the temperature's term, where the temperature is not learned."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return super().forward(tensordict).exclude("loss_alpha")  # type: ignore[misc]


class _FixedSACLoss(_FixedTemperature, SACLoss):
    pass


class _FixedDiscreteSACLoss(_FixedTemperature, DiscreteSACLoss):
    pass


_NO_ENTROPY = 1e-12
"""A temperature at which the entropy bonus is lost in rounding; TorchRL takes its logarithm."""


def _loss(agent: SACAgent, cfg: SACConfig) -> SACLoss | DiscreteSACLoss:
    """TorchRL's loss of two critics, with the squared error."""
    tuned = cfg.entropy == "tuned"
    settings: dict[str, Any] = {
        "num_qvalue_nets": 2,
        "loss_function": "l2",
        "fixed_alpha": not tuned,
        "alpha_init": _NO_ENTROPY if cfg.entropy == "none" else cfg.temperature,
        "target_entropy": "auto" if cfg.target_entropy is None else cfg.target_entropy,
    }
    critic = agent.critic(time_aware=cfg.time_aware_critic)
    loss: SACLoss | DiscreteSACLoss
    if agent.discrete:
        encoding = "one_hot" if agent.one_hot else "categorical"
        kind = DiscreteSACLoss if tuned else _FixedDiscreteSACLoss
        settings |= {"action_space": encoding, "num_actions": agent.action_size}
        loss = kind(agent.actor_for_loss(), critic, **settings)
    else:
        if cfg.target_entropy is None:
            settings["target_entropy"] = -float(agent.action_size)
        loss = (SACLoss if tuned else _FixedSACLoss)(agent.actor_for_loss(), critic, **settings)
        assert loss.target_entropy is not None  # It becomes a buffer when it is first read.
    loss.make_value_estimator(ValueEstimators.TD0, gamma=cfg.gamma)
    return loss.to(agent.device)


def _without_reward(batch: TensorDictBase) -> TensorDictBase:
    """A shallow copy with zeros for the true reward, which a transform moves elsewhere."""
    zeros = torch.zeros(*batch.shape, 1, device=batch.get(OBSERVATION).device)
    return batch.clone(False).set(REWARD, zeros)


def _tensors(module: nn.Module) -> dict[str, Tensor]:
    """Parameters and buffers, those of target networks included, by name."""
    return {**dict(module.named_parameters()), **dict(module.named_buffers())}
