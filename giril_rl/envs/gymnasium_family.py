"""The family of Gymnasium's own environments, PyBullet's among them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import cast

import gymnasium

from giril_rl.config.schema import TaskConfig
from giril_rl.envs.batched import BatchedEnv
from giril_rl.envs.fixed import AfterFailure, FixedHorizonEnv
from giril_rl.envs.gym_api import import_package, registered_spec, silent_stdout
from giril_rl.envs.vector import GymImageEnv, GymVectorEnv
from giril_rl.errors import UserError, first_line
from giril_rl.runs.randomness import Use

BULLET = "BulletEnv"
BULLET_PACKAGE = "pybullet_envs_gymnasium"


def gym_factory(task: TaskConfig) -> Callable[[], gymnasium.Env]:
    """See :func:`giril_rl.envs.gym_factory`."""
    bullet = BULLET in task.env_id
    if bullet:
        import_package(BULLET_PACKAGE)
    spec = registered_spec(task.env_id)
    limit = task.max_episode_steps or spec.max_episode_steps
    if limit is None:
        raise UserError(
            f"{task.env_id} has no time limit, so that an episode may never end: "
            "set task.max_episode_steps."
        )

    def make_one() -> gymnasium.Env:
        # pybullet prints on both streams, when imported and whenever it connects, at a first reset.
        try:
            with silent_stdout(stderr=True) if bullet else contextlib.nullcontext():
                env = gymnasium.make(spec.id, max_episode_steps=limit, disable_env_checker=True)
                if bullet:
                    env.reset()
        except gymnasium.error.DependencyNotInstalled as error:
            raise UserError(f"{task.env_id} needs another package: {error}") from None
        except ModuleNotFoundError as error:
            raise UserError(
                f"{task.env_id} needs the module {error.name}, which is not installed: install it, "
                "or mend the entry point that the id is registered with."
            ) from error
        except Exception as error:
            raise UserError(
                f"{task.env_id} cannot be made ({type(error).__name__}: {first_line(error)}): see "
                "that gymnasium.make gives it without further arguments."
            ) from error
        return env

    return make_one


def make(task: TaskConfig, num_envs: int, seed: int, use: Use) -> BatchedEnv:
    """See :func:`giril_rl.envs.make_env`."""
    make_fn = gym_factory(task)
    if task.horizon == "fixed":
        after_failure = cast(AfterFailure, task.after_failure)
        return FixedHorizonEnv(make_fn, num_envs, after_failure=after_failure, seed=seed, use=use)
    kind = GymImageEnv if task.family.observation == "image" else GymVectorEnv
    return kind(make_fn, num_envs, seed=seed, use=use)
