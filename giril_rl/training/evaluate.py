"""The true score of a policy, on fresh environments and whole episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from giril_rl.configs import TaskConfig
from giril_rl.envs import for_scores, make_env
from giril_rl.networks.agents import check_actions
from giril_rl.randomness import Use, seeded, stream_seed


class Player(Protocol):
    """Whatever can be scored, such as :class:`~giril_rl.networks.policy.ActorCritic`."""

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
) -> Scores:
    """Plays each of ``episodes`` fresh environments for exactly one episode.

    One episode per environment, whatever its length: counting the first ones to end would favour
    short episodes. Torch's random state is put back afterwards.

    Args:
        agent: the policy; its running normalisation is used as it is and not updated.
        task: the task to play; always its own episodes and whole games, whatever
            ``task.horizon`` and ``task.episode`` say.
        episodes: number of episodes.
        seed: root of the episodes' seeds and seed of the sampled actions.
        deterministic: play the distribution's mode rather than samples.
        use: what the episodes are for.

    Returns:
        The scores; the standard deviation is the sample's (n - 1), 0 for one episode.

    Raises:
        UserError: if the agent was made for other actions than the task's.

    Examples:
        >>> from giril_rl.networks.policy import ActorCritic
        >>> task = TaskConfig(name="cartpole", env_id="CartPole-v1")
        >>> env = make_env(task, num_envs=1, seed=0)
        >>> scores = evaluate(
        ...     ActorCritic(4, env.action_spec), task, episodes=5, seed=0, deterministic=True
        ... )
        >>> scores.episodes, scores.return_mean == scores.episode_length_mean
        (5, True)
    """
    env = make_env(for_scores(task), episodes, seed, use=use)
    check_actions(agent, env)
    policy = agent.acting()
    mode = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    returns = torch.zeros(episodes, dtype=torch.float64)
    lengths = torch.zeros(episodes, dtype=torch.int64)
    playing = torch.ones(episodes, dtype=torch.bool)
    lives = 0
    device = getattr(agent, "device", torch.device("cpu"))
    with seeded(stream_seed(use, seed), device), torch.no_grad(), set_exploration_type(mode):
        tensordict = env.reset()
        while playing.any():
            tensordict, following = env.step_and_maybe_reset(policy(tensordict))
            reward: Tensor = tensordict.get(("next", "reward")).squeeze(-1)
            returns[playing] += reward[playing].double()
            lengths += playing
            life_over = tensordict.get(("next", "life_over"), None)
            if life_over is not None:
                lives += int(life_over.squeeze(-1)[playing].sum())
            playing &= ~tensordict.get(("next", "done")).squeeze(-1)
            tensordict = following
    env.close()
    return Scores(
        return_mean=returns.mean().item(),
        return_std=returns.std().item() if episodes > 1 else 0.0,
        return_median=returns.quantile(0.5).item(),
        episode_length_mean=lengths.double().mean().item(),
        life_length_mean=lengths.sum().item() / lives if lives else None,
        episodes=episodes,
        returns=returns.tolist(),
    )


def evaluate_both(
    agent: Player, task: TaskConfig, *, episodes: int, seed: int
) -> dict[str, object]:
    """Scores of the policy as it was trained, sampling; of its mode under ``"deterministic"``.

    The first are what tables quote: PPO maximises the return of the sampling policy, and the
    paper's curves are of its training episodes. Where actions keep a deviation near 1, the mode is
    a policy that was never tried. The entries are those of :class:`Scores`.
    """
    scores = {
        deterministic: evaluate(
            agent, task, episodes=episodes, seed=seed, deterministic=deterministic
        )
        for deterministic in (True, False)
    }
    return {**scores[False].as_dict(), "deterministic": scores[True].as_dict()}
