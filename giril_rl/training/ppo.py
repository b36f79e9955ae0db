"""Proximal policy optimisation (Schulman et al., 2017) on TorchRL's GAE and ClipPPOLoss."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from giril_rl.config.schema import ExpertRunConfig, PPOConfig, RewardRunConfig, ScalingConfig
from giril_rl.errors import UserError
from giril_rl.graphs.gradients import TracedGradients
from giril_rl.policies import ActingPolicy, PPOAgent, collecting
from giril_rl.transforms.scaling import ResetRule, ReturnScaling

LOSS_KEYS = ("action_log_prob", "advantage", "value_target")
"""What the loss reads of a minibatch, besides the networks' inputs and the agent's draws."""
NO_FAILURE = "no_failure"
"""Replaces ``"terminated"`` where a failure is taken for a time limit: False everywhere."""


class PPO:
    """An :class:`~giril_rl.training.algorithm.Algorithm`: GAE, then epochs of minibatches.

    Args:
        agent: policy and value network, trained in place.
        cfg: settings of PPO.
        steps: environment steps of the whole training, rounded up to whole batches.
        termination: "ends" (nothing is worth anything after a failure) or "bootstrap" (a failure is
            taken for a time limit: the value of the terminal observation continues). Either way
            ``done`` ends the episode, beyond which advantages do not look.

    Raises:
        UserError: for another ``termination``.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from giril_rl.policies import ActorCritic
        >>> agent = ActorCritic(3, Bounded(-1, 1, shape=(1,)))
        >>> ppo = PPO(agent, PPOConfig(num_envs=2, rollout=4, minibatch=8), steps=100)
        >>> ppo.steps  # 13 batches of 8
        104
        >>> steps = [ppo.act()(TensorDict({"observation": torch.randn(2, 3)}, [2])) for _ in "1234"]
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
        >>> sorted(ppo.update(batch))
        ['clip_fraction', 'kl_approx', 'loss_critic', 'loss_objective']
    """

    name = "ppo"
    own: None = None
    """PPO keeps no transitions: a reward that learns beside it takes the batch collected last."""

    def __init__(
        self, agent: PPOAgent, cfg: PPOConfig, *, steps: int, termination: str = "ends"
    ) -> None:
        if termination not in ("ends", "bootstrap"):
            raise UserError(f"termination={termination}: choose one of ends, bootstrap.")
        self.agent, self.cfg = agent, cfg
        self.num_envs, self.checkpoint_every = cfg.num_envs, cfg.checkpoint_every
        self.frames_per_batch = self.log_every = cfg.num_envs * cfg.rollout
        self.steps = cfg.whole_batches(steps)
        self.bootstraps_failure = termination == "bootstrap"
        self._taken = 0
        # Standardised over the whole batch, not per minibatch: a minibatch without any event would
        # have its noise scaled to unit variance, and the policy would follow it.
        self.advantage = GAE(
            gamma=cfg.gamma,
            lmbda=cfg.lmbda,
            value_network=agent.value_network(),
            average_gae=True,
        )
        if self.bootstraps_failure:
            self.advantage.set_keys(terminated=NO_FAILURE)
        loss = RecordableClipPPOLoss(
            agent.actor_for_loss(),
            agent.critic_for_loss(),
            clip_epsilon=cfg.clip,
            clip_value=cfg.clip if cfg.clip_value else None,
            entropy_bonus=cfg.entropy_coef > 0,
            entropy_coeff=cfg.entropy_coef,
            critic_coeff=cfg.value_coef,
            loss_critic_type="l2",
            normalize_advantage=False,
            log_explained_variance=False,
            functional=False,
        )
        # The clipped value loss compares with the value as it was.
        self.keys = (
            *agent.input_keys,
            agent.drawn_key,
            *LOSS_KEYS,
            *["state_value"] * cfg.clip_value,
        )
        self.gradients = TracedGradients(
            loss,
            keys=self.keys,
            log=("kl_approx", "clip_fraction"),
            max_grad_norm=cfg.max_grad_norm,
            compile=cfg.compile,
        )
        # The implementation that updates all parameters in one call.
        self.optimizer = torch.optim.Adam(
            self.gradients.parameters, lr=cfg.lr, eps=1e-5, fused=True
        )

    def act(self) -> ActingPolicy:
        """The policy that collects: it samples, and shares the agent's weights."""
        return collecting(self.agent, compile=self.cfg.compile)

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """One PPO update on a batch ``(num_envs, time)`` that :meth:`act` collected.

        Returns:
            Means over the update's last epoch.
        """
        cfg = self.cfg
        if cfg.anneal_lr:
            for group in self.optimizer.param_groups:
                group["lr"] = cfg.lr * (1 - self._taken / self.steps)
        self._add_advantage(batch)
        flat = [batch.get(key).flatten(0, 1) for key in self.keys]
        for _ in range(cfg.epochs):
            logs: list[dict[str, Tensor]] = []
            order = torch.randperm(batch.numel()).to(self.agent.device)
            for minibatch in zip(*(x[order].split(cfg.minibatch) for x in flat), strict=True):
                logs.append(self.gradients.step(minibatch))
                self.optimizer.step()
        self.agent.update_normaliser(batch.get("observation"))
        self._taken += batch.numel()
        return {k: torch.stack([log[k] for log in logs]).mean().item() for k in logs[0]}

    @torch.no_grad()
    def _add_advantage(self, batch: TensorDictBase) -> None:
        # Where the environment was reset unnoticed, the value is that of where it goes on.
        onward = batch.get(("next", "following_observation"), None)
        if onward is None:
            onward = batch.get(("next", "observation"))
        self.agent.prepare(batch, onward)
        if self.bootstraps_failure:
            failed = batch.get(("next", "terminated"))
            batch.set(("next", NO_FAILURE), torch.zeros_like(failed))
        self.advantage(batch)

    def state_dict(self) -> dict[str, Any]:
        """Agent, optimizer and environment steps so far."""
        return {
            "agent": dict(self.agent.state_dict()),
            "optimizer": self.optimizer.state_dict(),
            "steps": self._taken,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        self.agent.load_state_dict(state["agent"])
        self.optimizer.load_state_dict(state["optimizer"])
        self._taken = state["steps"]

    def close(self) -> None:
        """Nothing: all that PPO keeps is in its checkpoint."""


def return_scaling(
    cfg: RewardRunConfig | ExpertRunConfig | ScalingConfig, gamma: float | None = None
) -> list[ReturnScaling]:
    """The reward scaling of a run whose learner is PPO: a transform, or none.

    SAC scales the rewards that it draws from its replay buffer, so that nothing scales them before.

    Args:
        cfg: the run's settings; or those of the scaling alone, with ``gamma``.
        gamma: the discount, beside the settings of the scaling alone.

    Examples:
        >>> return_scaling(ScalingConfig(enabled=False), gamma=0.99)
        []
        >>> return_scaling(RewardRunConfig(algorithm="sac"))
        []
    """
    if not isinstance(cfg, ScalingConfig):
        return [] if cfg.algorithm != "ppo" else return_scaling(cfg.scaling, cfg.ppo.gamma)
    if not cfg.enabled:
        return []
    assert gamma is not None
    return [ReturnScaling(gamma, reset=cast(ResetRule, cfg.reset), clip=cfg.clip)]


class RecordableClipPPOLoss(ClipPPOLoss):
    """:class:`torchrl.objectives.ClipPPOLoss` without a branch on a tensor's value.

    TorchRL estimates the entropy from samples where it is not finite. A recorded graph cannot
    decide that anew at each call, and the distributions here know their entropy. TorchRL also asks
    whether the tensor ``clip_value`` is zero, which makes the CPU wait for a GPU.
    """

    clip_value: float | None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if "clip_value" in self._buffers:
            bound = self.get_buffer("clip_value").item()
            del self.clip_value
            self.clip_value = bound

    def _get_entropy(self, dist: Any, adv_shape: torch.Size) -> Tensor:
        return dist.entropy().unsqueeze(-1)
