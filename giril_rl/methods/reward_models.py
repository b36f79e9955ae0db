"""Reward models as a run's settings have them: weights fresh, scaler fitted, nothing trained."""

from __future__ import annotations

from typing import cast

from tensordict import TensorDictBase

from giril_rl.config.schema import (
    AdversarialConfig,
    BottleneckConfig,
    CuriosityConfig,
    GenerativeConfig,
)
from giril_rl.envs import BatchedEnv, observation_kind
from giril_rl.rewards import (
    BottleneckReward,
    CopyReward,
    CuriosityReward,
    DiscriminatorReward,
    DiscriminatorScaling,
    GenerativeReward,
    ObservationScaler,
    PixelScaler,
    Prior,
    RewardForm,
    ScalingRule,
)
from giril_rl.runs.randomness import stream_seed


def generative_reward(
    cfg: GenerativeConfig, env: BatchedEnv, data: TensorDictBase, *, seed: int
) -> GenerativeReward:
    """GIRIL's reward module, to be fitted.

    Args:
        cfg: its settings, of which ``alpha`` is the loss's and ``seed`` the caller's to resolve.
        env: the environment, for its specs.
        data: the demonstrated transitions to learn from, to which the scaler is fitted.
        seed: seed of weights and noise. The global random state is neither read nor changed.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from giril_rl.config.schema import TaskConfig
        >>> from giril_rl.envs import make_env
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> data = TensorDict({"observation": torch.rand(9, 4)}, [9])
        >>> generative_reward(GenerativeConfig(), env, data, seed=0).scaler
        ObservationScaler(4, rule='standardise', clamp=True)
    """
    prior = cast(Prior, cfg.prior)
    frames, size = _observation(env)
    if frames:
        reward = GenerativeReward.for_pixels(
            env.action_spec,
            channels=frames,
            beta=cfg.beta,
            scale=cfg.scale,
            prior=prior,
            clamp=cfg.clamp,
            seed=stream_seed("reward", seed),
        )
    else:
        reward = GenerativeReward.for_vectors(
            size,
            env.action_spec,
            hidden=cfg.hidden,
            beta=cfg.beta,
            scale=cfg.scale,
            prior=prior,
            normalise=cast(ScalingRule, cfg.normalise),
            clamp=cfg.clamp,
            seed=stream_seed("reward", seed),
        )
    reward.scaler.fit(data.get("observation"))
    return reward


def curiosity_reward(
    cfg: CuriosityConfig, env: BatchedEnv, data: TensorDictBase, *, seed: int
) -> CuriosityReward:
    """CDIL's reward module, to be fitted.

    Args:
        cfg: its settings, of which ``features`` is the loss's and ``seed`` the caller's to resolve.
        env: the environment, for its specs.
        data: the demonstrated transitions to learn from, to which the scaler is fitted.
        seed: seed of the weights. The global random state is neither read nor changed.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from giril_rl.config.schema import TaskConfig
        >>> from giril_rl.envs import make_env
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> data = TensorDict({"observation": torch.rand(9, 4)}, [9])
        >>> curiosity_reward(CuriosityConfig(), env, data, seed=0).scaler
        ObservationScaler(4, rule='standardise', clamp=True)
    """
    frames, size = _observation(env)
    if frames:
        reward = CuriosityReward.for_pixels(
            env.action_spec, channels=frames, scale=cfg.scale, seed=stream_seed("reward", seed)
        )
    else:
        reward = CuriosityReward.for_vectors(
            size,
            env.action_spec,
            hidden=cfg.hidden,
            model_hidden=cfg.model_hidden,
            scale=cfg.scale,
            normalise=cast(ScalingRule, cfg.normalise),
            clamp=cfg.clamp,
            seed=stream_seed("reward", seed),
        )
    reward.scaler.fit(data.get("observation"))
    return reward


def copy_reward(cfg: GenerativeConfig, env: BatchedEnv, data: TensorDictBase) -> CopyReward:
    """The reward of the copy predictor, on GIRIL's scale.

    Args:
        cfg: GIRIL's settings.
        env: the environment, for its specs.
        data: the demonstrated transitions to learn from, to which the scaler is fitted.
    """
    frames, size = _observation(env)
    scaler: ObservationScaler | PixelScaler
    if frames:
        scaler = PixelScaler(clamp=cfg.clamp)
    else:
        scaler = ObservationScaler(size, rule=cast(ScalingRule, cfg.normalise), clamp=cfg.clamp)
    return CopyReward(scaler.fit(data.get("observation")), scale=cfg.scale)


def discriminator_reward(
    cfg: AdversarialConfig, env: BatchedEnv, data: TensorDictBase, *, seed: int
) -> DiscriminatorReward:
    """GAIL's reward module, to be trained beside the policy.

    Args:
        cfg: its settings, of which those of its training are the learner's.
        env: the environment, for its specs.
        data: the demonstrated transitions to learn from, to which the scaler is fitted unless it
            follows the policy.
        seed: seed of the weights. The global random state is neither read nor changed.
    """
    form = cast(RewardForm, cfg.form)
    frames, size = _observation(env)
    if frames:
        reward = DiscriminatorReward.for_pixels(
            env.action_spec, channels=frames, form=form, seed=stream_seed("reward", seed)
        )
    else:
        reward = DiscriminatorReward.for_vectors(
            size,
            env.action_spec,
            hidden=cfg.hidden,
            form=form,
            normalise=cast(DiscriminatorScaling, cfg.normalise),
            clamp=cfg.clamp,
            seed=stream_seed("reward", seed),
        )
    reward.fit_scaler(data.get("observation"))
    return reward


def bottleneck_reward(
    cfg: BottleneckConfig, env: BatchedEnv, data: TensorDictBase, *, seed: int
) -> BottleneckReward:
    """VAIL's reward module, to be trained beside the policy.

    Args:
        cfg: its settings, see :func:`discriminator_reward`.
        env: the environment, for its specs.
        data: the demonstrated transitions to learn from, to which the scaler is fitted unless it
            follows the policy.
        seed: seed of the weights. The global random state is neither read nor changed.
    """
    form = cast(RewardForm, cfg.form)
    frames, size = _observation(env)
    if frames:
        reward = BottleneckReward.for_pixels(
            env.action_spec,
            channels=frames,
            form=form,
            latent=cfg.latent,
            seed=stream_seed("reward", seed),
        )
    else:
        reward = BottleneckReward.for_vectors(
            size,
            env.action_spec,
            hidden=cfg.hidden,
            form=form,
            normalise=cast(DiscriminatorScaling, cfg.normalise),
            clamp=cfg.clamp,
            latent=cfg.latent,
            seed=stream_seed("reward", seed),
        )
    reward.fit_scaler(data.get("observation"))
    return reward


def _observation(env: BatchedEnv) -> tuple[int, int]:
    """Frames in an observation (0 for vectors), and the size of its last dimension."""
    spec = env.observation_spec["observation"]
    return (spec.shape[-3] if observation_kind(env) == "image" else 0), spec.shape[-1]
