"""Reward models as a run's settings have them: weights fresh, scaler fitted, nothing trained."""

from __future__ import annotations

from typing import cast

from giril_rl.configs import CuriosityConfig, GenerativeConfig
from giril_rl.demos import Demonstration
from giril_rl.envs import BatchedEnv
from giril_rl.rewards import CuriosityReward, GenerativeReward, Prior, ScalingRule


def generative_reward(
    cfg: GenerativeConfig, env: BatchedEnv, demo: Demonstration, *, seed: int
) -> GenerativeReward:
    """GIRIL's reward module, to be fitted.

    Args:
        cfg: its settings, of which ``alpha`` is the loss's and ``seed`` the caller's to resolve.
        env: the environment, for its specs.
        demo: the demonstration, all of whose observations the scaler is fitted to.
        seed: seed of weights and noise. The global random state is neither read nor changed.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from giril_rl.configs import TaskConfig
        >>> from giril_rl.envs import make_env
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> demo = Demonstration(TensorDict({"observation": torch.rand(9, 4)}, [9]))
        >>> generative_reward(GenerativeConfig(), env, demo, seed=0).scaler
        ObservationScaler(4, rule='standardise', clamp=True)
    """
    reward = GenerativeReward.for_vectors(
        env.observation_spec["observation"].shape[-1],
        env.action_spec,
        hidden=cfg.hidden,
        beta=cfg.beta,
        scale=cfg.scale,
        prior=cast(Prior, cfg.prior),
        normalise=cast(ScalingRule, cfg.normalise),
        clamp=cfg.clamp,
        seed=seed,
    )
    reward.scaler.fit(demo.transitions["observation"])
    return reward


def curiosity_reward(
    cfg: CuriosityConfig, env: BatchedEnv, demo: Demonstration, *, seed: int
) -> CuriosityReward:
    """CDIL's reward module, to be fitted.

    Args:
        cfg: its settings, of which ``features`` is the loss's and ``seed`` the caller's to resolve.
        env: the environment, for its specs.
        demo: the demonstration, all of whose observations the scaler is fitted to.
        seed: seed of the weights. The global random state is neither read nor changed.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from giril_rl.configs import TaskConfig
        >>> from giril_rl.envs import make_env
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> demo = Demonstration(TensorDict({"observation": torch.rand(9, 4)}, [9]))
        >>> curiosity_reward(CuriosityConfig(), env, demo, seed=0).scaler
        ObservationScaler(4, rule='standardise', clamp=True)
    """
    reward = CuriosityReward.for_vectors(
        env.observation_spec["observation"].shape[-1],
        env.action_spec,
        hidden=cfg.hidden,
        model_hidden=cfg.model_hidden,
        scale=cfg.scale,
        normalise=cast(ScalingRule, cfg.normalise),
        clamp=cfg.clamp,
        seed=seed,
    )
    reward.scaler.fit(demo.transitions["observation"])
    return reward
