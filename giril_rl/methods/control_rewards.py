"""The rewards that stand in for a learned one, made as the learned ones are."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from giril_rl.config.schema import ControlRunConfig
from giril_rl.demos import Demonstration, holdout, subsample
from giril_rl.envs import BatchedEnv
from giril_rl.methods.reward_models import copy_reward, curiosity_reward, generative_reward
from giril_rl.rewards import (
    AffineReward,
    ConstantReward,
    GenerativeRewardLoss,
    NoiseReward,
)
from giril_rl.runs.metrics import METRICS, read_metrics
from giril_rl.runs.run import Run
from giril_rl.training import (
    HeldAction,
    RandomPolicy,
    check_discrete,
    fit_reward,
    held_action_scores,
)
from giril_rl.transforms.intrinsic import device_of


def check_baseline(cfg: ControlRunConfig) -> None:
    """Refuses a policy that the task's actions do not allow, before any long work.

    Raises:
        UserError: for ``held_action`` without discrete actions, ``random`` without bounds.
    """
    if cfg.reward == "held_action":
        check_discrete(cfg.task)
    elif cfg.reward == "random":
        RandomPolicy.of_task(cfg.task, cfg.seed)


def baseline_policy(cfg: ControlRunConfig, run: Run) -> RandomPolicy | HeldAction | None:
    """The policy that is scored as it is; None where the control is a reward to learn from.

    The held action is chosen in episodes of the training's seed and scored in the evaluation's.

    Args:
        cfg: the run's settings.
        run: where the scores of all actions are logged.
    """
    if cfg.reward == "random":
        return RandomPolicy.of_task(cfg.task, cfg.seed)
    if cfg.reward != "held_action":
        return None
    scores = held_action_scores(cfg.task, episodes=cfg.held_episodes, seed=cfg.seed)
    run.truncate_metrics("held_action", -1)
    for action, score in enumerate(scores):
        run.log(action, {"held_action/return_mean": score}, phase="held_action")
    return HeldAction.of_task(cfg.task, scores.index(max(scores)))


def control_reward(
    cfg: ControlRunConfig, env: BatchedEnv, demo: Demonstration | None, run: Run
) -> tuple[TensorDictModuleBase, dict[str, int]]:
    """The reward module that ``cfg.reward`` names, and the seeds that it depends on.

    Args:
        cfg: the run's settings; ``cfg.giril`` and ``cfg.icm`` mean what they do in their recipes.
        env: the environment, for its specs.
        demo: the demonstration; None for ``constant``.
        run: where a fit's metrics and checkpoints go, and the moments that were matched.

    Raises:
        UserError: if the fitted reward is the same for all transitions and noise should match it.
    """
    if demo is None:
        return ConstantReward(), {}
    pairs = subsample(demo, cfg.demo.subsample)
    if cfg.reward == "copy":
        return copy_reward(cfg.giril, env, pairs).to(cfg.device), {}
    part = cfg.icm if cfg.reward == "untrained_icm" else cfg.giril
    seed = cfg.seed if part.seed is None else part.seed
    seeds = {"reward": seed}
    if cfg.reward == "untrained_icm":
        return curiosity_reward(cfg.icm, env, pairs, seed=seed).to(cfg.device), seeds
    reward = generative_reward(cfg.giril, env, pairs, seed=seed).to(cfg.device)
    if cfg.reward == "untrained_giril":
        return reward, seeds
    fit_reward(
        GenerativeRewardLoss(reward, alpha=cfg.giril.alpha),
        pairs,
        cfg.fit,
        seed=seed,
        run=run,
        validation=holdout(demo, cfg.demo.subsample),
    )
    if cfg.reward == "negated_giril":
        return AffineReward(reward, scale=-1.0), seeds
    mean, variance = moments(reward, pairs)
    # A resumed run has them already, before the rows that it continues.
    if not any(row.get("phase") == "moments" for row in read_metrics(run.folder / METRICS)):
        run.log(0, {"moments/mean": mean, "moments/variance": variance}, phase="moments")
    if cfg.reward == "centred_giril":
        return AffineReward(reward, shift=-mean), seeds
    return NoiseReward(mean, variance, seed=seed), seeds


@torch.no_grad()
def moments(reward: TensorDictModuleBase, data: TensorDictBase) -> tuple[float, float]:
    """Mean and (population) variance of a reward over transitions.

    Args:
        reward: a module that writes one key, one value per transition.
        data: the transitions, which are left as they are.

    Examples:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.zeros(4, 2)}, [4])
        >>> moments(ConstantReward(3.0), data)
        (3.0, 0.0)
    """
    view = data.select(*reward.in_keys)
    device = device_of(reward)
    values = reward(view if device is None else view.to(device)).get(reward.out_keys[0]).double()
    return values.mean().item(), values.var(correction=0).item()
