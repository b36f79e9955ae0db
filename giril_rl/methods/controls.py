"""The recipe `control`: its settings, and the reward that its registry entry describes."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from giril_rl.config.schema import AveragedRunConfig, FitConfig, knob, needs_actions
from giril_rl.demos import Demonstration, holdout, subsample
from giril_rl.envs import BatchedEnv
from giril_rl.rewards import CuriosityConfig, GenerativeConfig
from giril_rl.rewards.entropy_bonus import EntropyBonusConfig
from giril_rl.rewards.method import Method
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


def _controls() -> dict[str, Any]:
    """The registry's controls; it imports all methods, for which help need not wait."""
    return import_module("giril_rl.methods.registry").controls()


@dataclass
class ControlRunConfig(AveragedRunConfig):
    """Settings of the controls' recipe; those that the chosen reward does not use are not read."""

    reward: str = knob(
        "constant",
        "the reward that stands in for a learned one; random: no reward, a random policy's score; "
        "held_action: no reward, the score of one action all the time, the best one",
        choices=_controls,
    )
    held_episodes: int = knob(20, "held_action: episodes that choose the action", low=1)
    giril: GenerativeConfig = field(default_factory=GenerativeConfig)
    icm: CuriosityConfig = field(default_factory=CuriosityConfig)
    bonus: EntropyBonusConfig = field(default_factory=EntropyBonusConfig)
    fit: FitConfig = field(default_factory=FitConfig)

    @property
    def method(self) -> Any:
        """The registry's entry of the control, a :class:`~giril_rl.rewards.method.Method`."""
        return _controls()[self.reward]

    @property
    def needs_demonstration(self) -> bool:
        """Whether the control is made of a demonstration, or its learner is given one.

        A control gets all that a method gets but the reward: with SAC, the demonstration in the
        replay buffer too.
        """
        replayed = self.algorithm == "sac" and self.sac.demonstration != "none"
        return self.method.demonstration or (replayed and self.trains)

    @property
    def reward_needs_actions(self) -> str | None:
        """What of the control reads the demonstration's actions; the copy reads none."""
        for part in ("giril", "icm"):
            settings = getattr(self, part)
            if type(settings) is self.method.settings and self.reward != "copy":
                return needs_actions(part, settings)
        return None

    @property
    def trains(self) -> bool:
        """Whether a policy is trained on a reward, rather than a fixed policy scored."""
        return self.method.build is not None


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
        demo: the demonstration; None for a control that needs none.
        run: where a fit's metrics and checkpoints go, and the moments that were matched.

    Raises:
        UserError: if the fitted reward is the same for all transitions and noise should match it.
    """
    method: Method = cfg.method
    assert method.build is not None
    parts = cfg.giril, cfg.icm, cfg.bonus
    settings = next((part for part in parts if type(part) is method.settings), None)
    seed = cfg.seed if settings is None or settings.seed is None else settings.seed
    pairs = None if demo is None else subsample(demo, cfg.demo.subsample)
    reward = method.build(settings, env, pairs, seed=seed).to(cfg.device)
    # A reward without weights, such as the copy, depends on no seed.
    seeds = {"reward": seed} if list(reward.parameters()) else {}
    if method.loss is not None:
        assert demo is not None and pairs is not None
        fit_reward(
            method.loss(reward, settings),
            pairs,
            cfg.fit,
            seed=seed,
            run=run,
            validation=holdout(demo, cfg.demo.subsample),
        )
    if method.derive is None:
        return reward, seeds
    return method.derive(reward, lambda: _logged_moments(reward, pairs, run), seed), seeds


def _logged_moments(
    reward: TensorDictModuleBase, pairs: TensorDictBase | None, run: Run
) -> tuple[float, float]:
    assert pairs is not None
    mean, variance = moments(reward, pairs)
    # A resumed run has them already, before the rows that it continues.
    if not any(row.get("phase") == "moments" for row in read_metrics(run.folder / METRICS)):
        run.log(0, {"moments/mean": mean, "moments/variance": variance}, phase="moments")
    return mean, variance


@torch.no_grad()
def moments(reward: TensorDictModuleBase, data: TensorDictBase) -> tuple[float, float]:
    """Mean and (population) variance of a reward over transitions.

    Args:
        reward: a module that writes one key, one value per transition.
        data: the transitions, which stay as they are.

    Examples:
        >>> from tensordict import TensorDict
        >>> from giril_rl.rewards import ConstantReward
        >>> data = TensorDict({"observation": torch.zeros(4, 2)}, [4])
        >>> moments(ConstantReward(3.0), data)
        (3.0, 0.0)
    """
    view = data.select(*reward.in_keys)
    device = device_of(reward)
    values = reward(view if device is None else view.to(device)).get(reward.out_keys[0]).double()
    return values.mean().item(), values.var(correction=0).item()
