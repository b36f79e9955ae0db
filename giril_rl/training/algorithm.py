"""What the training loop asks of a reinforcement learning algorithm, and the chosen one made."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from giril_rl.config.schema import DemoConfig, RunConfig, replay_needs_actions
from giril_rl.demos import Demonstration, subsample
from giril_rl.envs import BatchedEnv
from giril_rl.errors import UserError
from giril_rl.policies.agent import Agent
from giril_rl.policies.making import make_agent, make_sac_agent
from giril_rl.policies.soft_actor_critic import ELAPSED
from giril_rl.rewards.trajectory import fresh_episodes, trajectory_rewards
from giril_rl.runs.randomness import Use
from giril_rl.runs.run import Run
from giril_rl.training.ppo import PPO, return_scaling
from giril_rl.training.sac import SAC

REPLAY = "replay"
"""The folder of a run that holds its replay buffer until training is over."""


class Algorithm(Protocol):
    """Learns a policy from batches of experience, such as :class:`~giril_rl.training.ppo.PPO`.

    The loop collects, relabels, logs, checkpoints and resumes; an algorithm only acts and learns.

    Attributes:
        num_envs: parallel environments.
        frames_per_batch: transitions that are collected between two updates.
        steps: environment steps of the whole training, in whole batches.
        checkpoint_every: environment steps between checkpoints.
        log_every: environment steps between rows of metrics.
        name: of its metrics and checkpoint.
    """

    name: str
    num_envs: int
    frames_per_batch: int
    steps: int
    checkpoint_every: int
    log_every: int

    @property
    def agent(self) -> Agent:
        """The policy and its critics. They decide the device of learning."""
        ...

    def act(self) -> Callable[[TensorDictBase], TensorDictBase]:
        """The policy that collects, for TorchRL's collector."""
        ...

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learns from a batch ``(num_envs, time)`` with the reward to learn from.

        Returns:
            What is to be logged; of several batches the means are.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that later updates depend on, of the kinds that a checkpoint can hold."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        ...

    def close(self) -> None:
        """Frees what only further training needs, once training is over."""
        ...


def make_algorithm(
    env: BatchedEnv,
    cfg: RunConfig,
    *,
    run: Run,
    demo: Demonstration | None = None,
    transform: nn.Module | None = None,
    moving: bool = False,
    demonstration_reward: float | None = None,
    use: Use = "training",
) -> PPO | SAC:
    """The algorithm that ``cfg.algorithm`` names, with an untrained agent for ``env``.

    Args:
        env: the training environments, for their specs.
        cfg: the run's settings.
        run: whose folder SAC's replay buffer is in.
        demo: the demonstration, for SAC's replay buffer.
        transform: what writes the reward, as the training loop gets it.
        moving: whether the reward model learns beside the policy, so that SAC computes the reward
            anew for each minibatch.
        demonstration_reward: the reward of each demonstrated transition in SAC's replay buffer;
            None lets ``transform`` compute it.
        use: what the random numbers are for.

    Raises:
        UserError: if the algorithm has no form for the environment's spaces, or the replay buffer
            cannot hold the demonstration.
    """
    termination = getattr(cfg, "termination", "ends")
    if cfg.algorithm == "ppo":
        agent = make_agent(env, cfg.ppo, cfg.seed, use=use).to(cfg.device)
        return PPO(agent, cfg.ppo, steps=cfg.steps, termination=termination)
    known = None
    if demo is not None and cfg.sac.demonstration != "none":
        known = _demonstrated(demo, cfg, transform, moving, demonstration_reward)
    settings = getattr(cfg, "scaling", None)
    scaling = return_scaling(settings, cfg.sac.gamma) if settings is not None else []
    return SAC(
        make_sac_agent(env, cfg.sac, cfg.seed, use=use).to(cfg.device),
        cfg.sac,
        steps=cfg.steps,
        seed=cfg.seed,
        folder=run.folder / REPLAY,
        demonstration=known,
        relabel=transform if moving else None,
        relabel_episodes=_of_whole_episodes(transform),
        scaling=next(iter(scaling), None),
        termination=termination,
    )


def check_replay(cfg: RunConfig, demo: Demonstration) -> None:
    """Refuses a demonstration that cannot be put into SAC's replay buffer, where it is to be.

    Raises:
        UserError: if it has no actions, or more transitions than ``sac.buffer_size``, once 1 in
            ``demo.subsample`` was kept.
    """
    needed = replay_needs_actions(cfg)
    if needed is None:
        return
    if not demo.has_actions:
        raise UserError(f"the demonstration has no actions, which {needed}.")
    pairs = pairs_of(cfg, demo)
    if pairs > cfg.sac.buffer_size:
        raise UserError(
            f"sac.buffer_size={cfg.sac.buffer_size} is less than the demonstration's {pairs:,} "
            "transitions: give the buffer more room, or set sac.demonstration=none."
        )


def _of_whole_episodes(transform: nn.Module | None) -> Callable[..., TensorDictBase] | None:
    """What relabels whole episodes, where a reward is known at an episode's end only."""
    parts = [] if transform is None else trajectory_rewards(transform)
    if transform is None or not any(part.whole_episodes for part in parts):
        return None

    def relabel(episode: TensorDictBase) -> TensorDictBase:
        with fresh_episodes(transform, learn=True):
            return transform(episode)

    return relabel


def _demonstrated(
    demo: Demonstration,
    cfg: RunConfig,
    transform: nn.Module | None,
    moving: bool,
    reward: float | None,
) -> TensorDictBase:
    """The demonstration's transitions, 1 in ``demo.subsample``, with the reward to learn from.

    The reward is that of the whole episodes, of which transitions are left out afterwards.
    """
    check_replay(cfg, demo)
    known = demo.transitions.clone(False)
    if reward is not None:
        known.set(("next", "reward"), torch.full((len(demo), 1), reward))
    elif transform is not None and not moving:
        with fresh_episodes(transform):
            known = transform(known.unsqueeze(0).to(cfg.device)).squeeze(0)
    if cfg.sac.time_aware_critic:
        known.set(ELAPSED, cfg.sac.gamma ** _steps(demo).float())
    return subsample(Demonstration(known.cpu()), _every(cfg))


def _steps(demo: Demonstration) -> Tensor:
    """Each transition's place ``(n, 1)`` in its episode."""
    return torch.cat([torch.arange(length) for length in demo.lengths.tolist()]).unsqueeze(-1)


def pairs_of(cfg: RunConfig, demo: Demonstration) -> int:
    """The transitions that are learned from, once 1 in ``demo.subsample`` was kept."""
    return -(-len(demo) // _every(cfg))


def _every(cfg: RunConfig) -> int:
    chosen = getattr(cfg, "demo", None)
    return chosen.subsample if isinstance(chosen, DemoConfig) else 1
