"""Ranked episodes without a judge: a cloned policy, played with more and more random actions.

Less noise is taken to be better (D-REX: Brown, Goo and Niekum, CoRL 2019, section 5). The true
reward is summed up for the log alone, which shows whether that holds.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from scipy.stats import spearmanr
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from giril_rl.config.schema import BCConfig, PPOConfig, TaskConfig, knob
from giril_rl.envs import BatchedEnv, make_env
from giril_rl.policies import PPOAgent, make_agent
from giril_rl.runs.checkpoint import refusing_misfits
from giril_rl.runs.progress import progress
from giril_rl.runs.randomness import seeded, stream_seed
from giril_rl.runs.run import Run
from giril_rl.training.baselines import RandomPolicy
from giril_rl.training.cloning import clone_behaviour
from giril_rl.training.scoring import EPISODES_AT_ONCE

RANKING = "ranking"
"""The phase's name: of its metrics and of the file that keeps the episodes."""


@dataclass
class CloneConfig(BCConfig):
    """Behaviour cloning of the policy that is played with noise."""

    stop: str = knob(
        "fixed",
        "fixed: keep the last weights; held_out: those that are best on held-out transitions",
        choices=("held_out", "fixed"),
    )
    hidden: list[int] = knob([100, 100], "hidden layers of the clone (tanh)", low=1)

    def check(self, prefix: str, run: Any) -> None:
        """Refuses early stopping without validation pairs."""
        self.check_validation(prefix, run)


@dataclass
class RankingConfig:
    """The episodes that are ranked by their noise."""

    levels: int = knob(20, "noise levels 0, 1/levels, 2/levels and so on, below 1", low=2)
    episodes: int = knob(5, "episodes of each level", low=1)


@dataclass
class RankedEpisodes:
    """Episodes of one policy with random actions mixed in.

    Attributes:
        transitions: ``"observation"`` and ``"action"``, as executed, batch ``(n,)``, episode after
            episode.
        noise: of each episode, the probability of a random action, ``(episodes,)``.
        lengths: steps of each episode.
        returns: their true returns, which nothing may learn from.
    """

    transitions: TensorDict
    noise: Tensor
    lengths: Tensor
    returns: Tensor = field(repr=False)

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {
            **{key: self.transitions.get(key) for key in ("observation", "action")},
            **{key: getattr(self, key) for key in ("noise", "lengths", "returns")},
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> RankedEpisodes:
        """Puts back what :meth:`state_dict` gave.

        Raises:
            ValueError: if its parts do not belong together.
        """
        pairs = {key: state[key] for key in ("observation", "action")}
        parts = {key: state[key] for key in ("noise", "lengths", "returns")}
        if len({len(part) for part in parts.values()}) > 1:
            raise ValueError("its episodes are not of one number")
        steps = len(pairs["observation"])
        if (parts["lengths"] < 1).any() or int(parts["lengths"].sum()) != steps:
            raise ValueError("its lengths do not add up to its steps")
        return cls(TensorDict(pairs, [steps]), **parts)

    def summary(self) -> dict[str, Any]:
        """For ``result.json``: environment steps, and true returns by noise level.

        ``rank_correlation`` is Spearman's, over episodes, of the true return with less noise: 1
        where the ranking is right, None where all returns are equal.
        """
        levels = self.noise.unique()
        means = [self.returns[self.noise == level].mean().item() for level in levels]
        varied = len(self.returns.unique()) > 1 and len(levels) > 1
        correlation = float(spearmanr(-self.noise, self.returns).statistic) if varied else None
        return {
            "steps": int(self.lengths.sum()),
            "noise": levels.tolist(),
            "return_means": means,
            "rank_correlation": correlation,
        }


def play_with_noise(
    policy: Callable[[TensorDictBase], TensorDictBase],
    task: TaskConfig,
    noise: Tensor,
    *,
    seed: int,
    show_progress: bool = True,
) -> RankedEpisodes:
    """Plays one episode for each entry of ``noise``, the probability of a uniformly random action.

    No more than :data:`~giril_rl.training.scoring.EPISODES_AT_ONCE` are played at a time. The
    policy takes its most likely or mean action. Torch's random state is put back afterwards.

    Args:
        policy: what writes ``"action"`` for a batch of ``"observation"``.
        task: the task, with the horizon that the learner will have.
        noise: probabilities, ``(episodes,)``.
        seed: root of the episodes' seeds, and seed of the noise.
        show_progress: show a progress bar.

    Raises:
        UserError: for actions without bounds, which have no uniform distribution.

    Examples:
        >>> from giril_rl.training.baselines import HeldAction
        >>> task = TaskConfig(name="cartpole", env_id="CartPole-v1")
        >>> left = HeldAction.of_task(task, 0)
        >>> played = play_with_noise(
        ...     left, task, torch.tensor([0.0, 1.0]), seed=0, show_progress=False
        ... )
        >>> first = played.transitions["action"].split(played.lengths.tolist())[0]
        >>> first.any().item(), played.returns.tolist() == played.lengths.tolist()
        (False, True)
    """
    episodes = len(noise)
    parts: list[RankedEpisodes] = []
    with (
        seeded(stream_seed("ranking", seed)),
        torch.no_grad(),
        set_exploration_type(ExplorationType.DETERMINISTIC),
        progress(
            episodes, desc="noisy episodes", unit="episodes", disable=not show_progress
        ) as bar,
    ):
        for first in range(0, episodes, EPISODES_AT_ONCE):
            levels = noise[first : first + EPISODES_AT_ONCE]
            env = make_env(task, len(levels), seed, use="ranking")
            env.first_index = first
            with closing(env):
                random = RandomPolicy(env.action_spec, stream_seed("ranking", seed, first))
                parts.append(_play(env, policy, random, levels))
            bar.update(len(levels))
    return RankedEpisodes(
        torch.cat([part.transitions for part in parts]),
        noise,
        torch.cat([part.lengths for part in parts]),
        torch.cat([part.returns for part in parts]),
    )


def _play(
    env: BatchedEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    random: RandomPolicy,
    noise: Tensor,
) -> RankedEpisodes:
    """One episode in each simulator, all at once."""
    count = len(noise)
    playing = torch.ones(count, dtype=torch.bool)
    returns = torch.zeros(count, dtype=torch.float64)
    columns: dict[str, list[Tensor]] = {"observation": [], "action": [], "playing": []}
    tensordict = env.reset()
    while playing.any():
        action = policy(tensordict).get("action")
        other = random(TensorDict(batch_size=[count])).get("action")
        chosen = (torch.rand(count) < noise).reshape(count, *[1] * (action.ndim - 1))
        tensordict.set("action", torch.where(chosen, other, action))
        columns["playing"].append(playing.clone())
        for key in ("observation", "action"):
            columns[key].append(tensordict.get(key).clone())
        tensordict, following = env.step_and_maybe_reset(tensordict)
        reward = tensordict.get(("next", "reward")).squeeze(-1).double()
        scored = tensordict.get(("next", "scored"), None)
        returns += torch.where(playing if scored is None else playing & scored[:, 0], reward, 0.0)
        playing &= ~tensordict.get(("next", "done")).squeeze(-1)
        tensordict = following
    whole = {key: torch.stack(steps, 1) for key, steps in columns.items()}
    played = whole.pop("playing")
    pairs = {key: value[played] for key, value in whole.items()}
    return RankedEpisodes(TensorDict(pairs, [int(played.sum())]), noise, played.sum(1), returns)


def ranked_episodes(
    pairs: TensorDictBase,
    task: TaskConfig,
    settings: RankingConfig,
    clone: CloneConfig,
    *,
    seed: int,
    run: Run,
    validation: TensorDictBase | None = None,
    device: str = "cpu",
) -> RankedEpisodes:
    """Clones the demonstration and plays the clone with each level of noise; resumes by itself.

    The episodes are kept in the run's folder, as ``ranking.safetensors``. The mean true return of
    each level is in the metrics, of which nothing reads it.

    Args:
        pairs: the demonstrated transitions to clone.
        task: the task to play.
        settings: noise levels and episodes.
        clone: settings of the cloning.
        seed: seeds clone, episodes and noise.
        run: where metrics, checkpoints and the episodes go.
        validation: other pairs, for ``clone.stop=held_out``.
        device: where the clone is.

    Raises:
        Interrupted: after a checkpoint, if the user asked for it with Ctrl-C.
        UserError: for actions without bounds.
    """
    saved = run.load(RANKING)
    if saved is not None:
        with refusing_misfits(run, RANKING):
            run.fit_seconds += saved["seconds"]
            return RankedEpisodes.from_state(saved)
    agent, seconds = _clone(pairs, task, clone, seed, run, validation, device)
    began = time.perf_counter() - seconds
    levels = torch.arange(settings.levels, dtype=torch.float64) / settings.levels
    noise = levels.repeat_interleave(settings.episodes)
    played = play_with_noise(agent.acting(), task, noise, seed=seed)
    run.truncate_metrics(RANKING, -1)
    for level in noise.unique():
        at = played.noise == level
        returns = played.returns[at]
        row = {
            "ranking/noise": level.item(),
            "ranking/return_mean": returns.mean().item(),
            "ranking/return_std": returns.std().item() if len(returns) > 1 else 0.0,
            "ranking/episode_length_mean": played.lengths[at].double().mean().item(),
        }
        run.log(int(played.lengths[played.noise <= level].sum()), row, phase=RANKING)
    seconds = time.perf_counter() - began
    run.save(RANKING, {"seconds": seconds, **played.state_dict()})
    run.fit_seconds += seconds
    return played


def _clone(
    pairs: TensorDictBase,
    task: TaskConfig,
    cfg: CloneConfig,
    seed: int,
    run: Run,
    validation: TensorDictBase | None,
    device: str,
) -> tuple[PPOAgent, float]:
    """The clone, and the seconds that it took."""
    with closing(make_env(task, 1, seed, use="ranking")) as env:
        RandomPolicy(env.action_spec)  # Refuses actions without bounds before any work.
        agent = make_agent(env, replace(PPOConfig(), hidden=cfg.hidden), seed, use="ranking")
    agent = agent.to(device)
    own = stream_seed("ranking", seed)
    trained = clone_behaviour(
        agent, pairs, cfg, seed=own, run=run, validation=validation, phase="clone"
    )
    return agent.eval(), trained.seconds
