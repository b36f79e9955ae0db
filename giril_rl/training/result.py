"""The end of a run: scores, the learning curve and ``result.json``."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from torch import nn

from giril_rl.config.schema import AveragedRunConfig, DemoConfig, RewardRunConfig, RunConfig
from giril_rl.demos import Demonstration
from giril_rl.demos.shipped import demonstration_name
from giril_rl.moved import renamed_argument
from giril_rl.policies.agent import Agent
from giril_rl.policies.making import POLICY
from giril_rl.runs.curve import loss_points, write_curve, write_losses
from giril_rl.runs.identity import config_hash
from giril_rl.runs.machine import processor
from giril_rl.runs.metrics import METRICS, read_metrics
from giril_rl.runs.pretrained import Pretrained
from giril_rl.runs.run import Run
from giril_rl.training.algorithm import pairs_of
from giril_rl.training.baselines import HeldAction, RandomPolicy
from giril_rl.training.loop import Trained
from giril_rl.training.scoring import evaluate_both

REWARD = "reward"
"""The folder of a run that holds its reward, see :class:`giril_rl.runs.pretrained.Pretrained`."""
CARD_KEYS = (
    "method",
    "task",
    "profile",
    "seed",
    "env_steps",
    "return_mean",
    "return_std",
    "episodes",
    "expert_return_mean",
    "demo_return_mean",
    "demo_transitions",
)
"""What of a result the cards of policy and reward repeat."""


@renamed_argument("method", None)  # A run's method is the name of its recipe.
def finish_run(
    run: Run,
    cfg: RunConfig,
    agent: Agent | RandomPolicy | HeldAction,
    trained: Trained,
    *,
    expert: dict[str, Any] | None = None,
    demo: Demonstration | None = None,
    seeds: dict[str, int] | None = None,
    reward: nn.Module | None = None,
    more: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Scores the policy on fresh environments and writes policy, curve and ``result.json``.

    Args:
        run: the run's folder.
        cfg: the run's settings.
        agent: the trained policy; of one that was not trained nothing is saved but the number of
            the action that it holds.
        trained: its steps and seconds.
        expert: the expert's result, if there was one.
        demo: the demonstration, if there was one.
        seeds: seeds besides those of policy, evaluation, expert and demonstration; None takes the
            reward model's, if there is a reward.
        reward: the reward module, if there is one; kept beside the policy if it can be.
        more: further entries of ``result.json``, plain JSON values.

    Returns:
        What ``result.json`` holds.
    """
    scores = evaluate_both(agent, cfg.task, episodes=cfg.eval.episodes, seed=cfg.eval.seed)
    if seeds is None and reward is not None and isinstance(cfg, RewardRunConfig):
        seeds = {"reward": cfg.reward_seed}
    demonstrated = demo.mean_return() if demo is not None and demo.has_rewards else None
    result: dict[str, Any] = {
        "method": method_name(run.recipe, cfg),
        "task": cfg.task.name,
        "profile": _profile(cfg, trained),
        "algorithm": cfg.algorithm if trained.steps else None,
        "horizon": cfg.task.horizon,
        "termination": getattr(cfg, "termination", "ends"),
        "seed": cfg.seed,
        "seeds": {
            "policy": cfg.seed,
            "evaluation": cfg.eval.seed,
            **(seeds or {}),
            **_seeds_of(demo),
        },
        "env_steps": trained.steps,
        **scores,
        "wall_seconds": run.fit_seconds + trained.seconds,
        "fit_seconds": run.fit_seconds,
        "inexact_resumes": trained.inexact_resumes,
        "steps_per_second": trained.steps / max(trained.seconds, 1e-9),
        "expert_return_mean": None if expert is None else expert["return_mean"],
        "demo_return_mean": demonstrated,
        "score_over_demo": score_over_demonstration(scores["return_mean"], demonstrated),
        "demo": None if demo is None else _source(cfg, demo),
        "demo_id": None if demo is None else demo.demo_id,
        "demo_transitions": None if demo is None else len(demo),
        "demo_pairs": None if demo is None else pairs_of(cfg, demo),
        "config_hash": config_hash(cfg),
        "versions": run.versions,
        "processor": processor(),
        "finished_at": datetime.now(UTC).isoformat(timespec="seconds"),
        **_untrained(agent),
        **(more or {}),
    }
    card = {key: result[key] for key in CARD_KEYS}
    for folder, module in ((POLICY, agent), (REWARD, reward)):
        if isinstance(module, Pretrained):
            module.save_pretrained(run.folder / folder, card)
    _draw(run, result)
    run.finish(result)
    return result


def score_over_demonstration(score: float, demonstration: float | None) -> float | None:
    """A score divided by the demonstration's return; None where the quotient would mislead.

    That is where the return is unknown or not above zero, and where the score is negative.

    Examples:
        >>> score_over_demonstration(600.0, 800.0), score_over_demonstration(0.0, 800.0)
        (0.75, 0.0)
        >>> score_over_demonstration(-5.0, 800.0), score_over_demonstration(-5.0, -10.0)
        (None, None)
    """
    if demonstration is None or demonstration <= 0 or score < 0:
        return None
    return score / demonstration


def _untrained(agent: nn.Module) -> dict[str, Any]:
    """What remakes a policy that holds no weights."""
    if isinstance(agent, HeldAction):
        return {"held_action": agent.action}
    return {"random_policy": True} if isinstance(agent, RandomPolicy) else {}


def _draw(run: Run, result: dict[str, Any]) -> None:
    """The run's picture: its losses where it was cloned, its learning curve otherwise."""
    rows = read_metrics(run.folder / METRICS)
    names = {"recipe": result["method"], "task": result["task"], "seed": result["seed"]}
    if loss_points(rows):
        write_losses(run.folder, rows, final_return=result["return_mean"], **names)
        return
    write_curve(
        run.folder,
        rows,
        expert_return=result["expert_return_mean"],
        demo_return=result["demo_return_mean"],
        final_return=result["return_mean"],
        final_std=result["return_std"],
        final_step=result["env_steps"],
        **names,
    )


def method_name(recipe: str, cfg: RunConfig) -> str:
    """A run's method: the recipe's name; of the recipe ``control``, with the reward that it takes.

    Examples:
        >>> method_name("my_recipe", RunConfig())
        'my_recipe'
    """
    reward = getattr(cfg, "reward", None)
    return f"control:{reward}" if recipe == "control" and isinstance(reward, str) else recipe


def _profile(cfg: RunConfig, trained: Trained) -> str | None:
    """The profile, None where it makes no difference because nothing is averaged in either."""
    if not isinstance(cfg, AveragedRunConfig) or (cfg.batch_mean and not trained.averaged):
        return None
    return cfg.profile


def _source(cfg: RunConfig, demo: Demonstration) -> str:
    """Which demonstration it was: ``shipped:NAME/INDEX``, the given path, or who played it."""
    chosen = getattr(cfg, "demo", None)
    if isinstance(chosen, DemoConfig) and chosen.path is not None:
        return demonstration_name(chosen.path, cfg.task, cfg.seed)
    return f"player {_seeds_of(demo)['expert']}, seed {demo.card.get('seed')}"


def _seeds_of(demo: Demonstration | None) -> dict[str, int | None]:
    """Seeds of a demonstration and of who played it; None where it does not say."""
    if demo is None:
        return {}
    player = demo.card.get("expert")
    seed = player.get("seed") if isinstance(player, dict) else None
    return {"expert": seed, "demo": demo.card.get("seed")}
