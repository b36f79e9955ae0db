"""The true score of a policy, on fresh environments and whole episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import BatchedEnv, for_scores, make_env
from giril_rl.errors import UserError
from giril_rl.policies import check_actions
from giril_rl.runs.progress import progress
from giril_rl.runs.randomness import Use, seeded, stream_seed

EPISODES_AT_ONCE = 20
"""Simulators that an evaluation has at a time; one of PyBullet's takes 30 MB."""


class Player(Protocol):
    """Whatever can be scored, such as :class:`~giril_rl.policies.ActorCritic`."""

    def acting(self) -> Callable[[TensorDictBase], TensorDictBase]:
        """What writes ``"action"`` for a batch of ``"observation"``."""
        ...


@dataclass
class Scores:
    """Undiscounted true returns over whole episodes.

    ``life_length_mean`` is steps divided by lives, None for tasks without lives.
    """

    return_mean: float
    return_std: float
    return_median: float
    episode_length_mean: float
    life_length_mean: float | None
    episodes: int
    returns: list[float]

    def as_dict(self) -> dict[str, object]:
        """Plain JSON values."""
        return asdict(self)


def evaluate(
    agent: Player,
    task: TaskConfig,
    *,
    episodes: int,
    seed: int,
    deterministic: bool,
    use: Use = "evaluation",
    show_progress: bool = True,
) -> Scores:
    """Plays each of ``episodes`` fresh environments for exactly one episode.

    One episode per environment, whatever its length: counting the first ones to end would favour
    short episodes. No more than :data:`EPISODES_AT_ONCE` are played at a time. Each has a seed of
    its own, by its number alone; the random numbers of sampled actions are shared by those that are
    played together. Torch's random state is put back afterwards.

    Args:
        agent: the policy, played in eval mode; its running normalisation is used as it is and not
            updated.
        task: the task to play; always its own episodes and whole games, whatever
            ``task.horizon`` and ``task.episode`` say.
        episodes: number of episodes.
        seed: root of the episodes' seeds and seed of the sampled actions.
        deterministic: play the distribution's mode rather than samples.
        use: what the episodes are for.
        show_progress: show a progress bar.

    Returns:
        The scores; the standard deviation is the sample's (n - 1), 0 for one episode.

    Raises:
        UserError: if the agent was made for other actions than the task's, or a return is not
            finite.

    Examples:
        >>> from giril_rl.policies import ActorCritic
        >>> task = TaskConfig(name="cartpole", env_id="CartPole-v1")
        >>> env = make_env(task, num_envs=1, seed=0)
        >>> scores = evaluate(
        ...     ActorCritic(4, env.action_spec), task, episodes=5, seed=0, deterministic=True
        ... )
        >>> scores.episodes, scores.return_mean == scores.episode_length_mean
        (5, True)
    """
    policy = agent.acting()
    mode = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    played: list[_Played] = []
    device = getattr(agent, "device", torch.device("cpu"))
    counted = progress(episodes, desc="evaluation", unit="episodes") if show_progress else None
    with (
        seeded(stream_seed(use, seed), device),
        torch.no_grad(),
        set_exploration_type(mode),
        _in_eval_mode(agent),
        counted or nullcontext(),
    ):
        for first in range(0, episodes, EPISODES_AT_ONCE):
            count = min(EPISODES_AT_ONCE, episodes - first)
            env = make_env(for_scores(task), count, seed, use=use)
            env.first_index = first
            with closing(env):
                check_actions(agent, env)
                played.append(_play(env, policy, counted))
    returns = torch.cat([part.returns for part in played])
    lengths = torch.cat([part.lengths for part in played])
    lives = sum(part.lives for part in played)
    if not returns.isfinite().all():
        number = int((~returns.isfinite()).nonzero()[0])
        raise UserError(
            f"the true return of evaluation episode {number} is {returns[number].item()}: the "
            f"environment {task.env_id} pays a reward that is no number; mend it, and make the run "
            "anew."
        )
    return Scores(
        return_mean=returns.mean().item(),
        return_std=returns.std().item() if episodes > 1 else 0.0,
        return_median=returns.quantile(0.5).item(),
        episode_length_mean=lengths.double().mean().item(),
        life_length_mean=lengths.sum().item() / lives if lives else None,
        episodes=episodes,
        returns=returns.tolist(),
    )


class _Played(NamedTuple):
    returns: Tensor
    lengths: Tensor
    lives: int


def _play(
    env: BatchedEnv, policy: Callable[[TensorDictBase], TensorDictBase], bar: progress | None
) -> _Played:
    """Plays one episode in each simulator."""
    count = env.batch_size[0]
    returns = torch.zeros(count, dtype=torch.float64)
    lengths = torch.zeros(count, dtype=torch.int64)
    playing = torch.ones(count, dtype=torch.bool)
    lives = 0
    tensordict = env.reset()
    while playing.any():
        tensordict, following = env.step_and_maybe_reset(policy(tensordict))
        reward: Tensor = tensordict.get(("next", "reward")).squeeze(-1)
        returns[playing] += reward[playing].double()
        lengths += playing
        life_over = tensordict.get(("next", "life_over"), None)
        if life_over is not None:
            lives += int(life_over.squeeze(-1)[playing].sum())
        ended = playing & tensordict.get(("next", "done")).squeeze(-1)
        playing &= ~ended
        if bar is not None and ended.any():
            bar.update(int(ended.sum()))
        tensordict = following
    return _Played(returns, lengths, lives)


@contextmanager
def _in_eval_mode(agent: Player) -> Iterator[None]:
    """Neither drops units nor updates batch statistics, whatever the mode that training left."""
    modules = agent.modules() if isinstance(agent, nn.Module) else ()
    training = [module for module in modules if module.training]
    for module in training:
        module.training = False
    try:
        yield
    finally:
        for module in training:
            module.training = True


def evaluate_both(agent: Player, task: TaskConfig, *, episodes: int, seed: int) -> dict[str, Any]:
    """Scores of the policy as tables quote it, and of the other way to play it.

    PPO's is sampled, and its mode is under ``"deterministic"``: PPO maximises the return of the
    sampling policy, and the paper's curves are of its training episodes. Where actions keep a
    standard deviation near 1, the mode is a policy that was never tried. SAC's is the mode, as is
    usual (Haarnoja et al., 2018), for it samples for the sake of exploration; its samples are under
    ``"sampled"``. The entries are those of :class:`Scores`.
    """
    scores = {
        deterministic: evaluate(
            agent, task, episodes=episodes, seed=seed, deterministic=deterministic
        )
        for deterministic in (True, False)
    }
    mode, sampled = scores[True].as_dict(), scores[False].as_dict()
    if getattr(agent, "samples_to_explore", False):
        return {**mode, "sampled": sampled}
    return {**sampled, "deterministic": mode}
