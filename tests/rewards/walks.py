"""Episodes of vectors for trajectory rewards, in environments and in batches that follow time."""

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from giril_rl.rewards.pwil import PWILReward
from giril_rl.rewards.sinkhorn import SinkhornReward

SPEC = Bounded(-1.0, 1.0, shape=(1,))


def walk(envs, steps, seed=0, ends=0.1):
    """A batch ``(envs, steps)`` of episodes of two numbers that end at random."""
    rng = np.random.default_rng(seed)
    done = rng.random((envs, steps, 1)) < ends
    state, observations, following = rng.normal(size=(envs, 2)), [], []
    for t in range(steps):
        observations.append(state)
        led = state + rng.normal(size=(envs, 2))
        following.append(led)
        state = np.where(done[:, t], rng.normal(size=(envs, 2)), led)
    observation, onward = (np.stack(x, 1).astype(np.float32) for x in (observations, following))
    return TensorDict(
        {
            "observation": torch.from_numpy(observation),
            "action": torch.from_numpy(rng.uniform(-1, 1, (envs, steps, 1)).astype(np.float32)),
            "next": {
                "observation": torch.from_numpy(onward),
                "done": torch.from_numpy(done),
                "reward": torch.zeros(envs, steps, 1),
            },
        },
        [envs, steps],
    )


def demonstration(length, seed=1):
    """One episode ``(length,)``."""
    demo = walk(1, length, seed, ends=0.0)[0]
    demo["next", "done"][-1] = True
    return demo


def pwil(demo, horizon, spec=SPEC, **kwargs):
    """PWIL's reward of a demonstration."""
    size = demo["observation"].shape[-1]
    reward = PWILReward(size, spec, atoms=len(demo), horizon=horizon, **kwargs)
    return reward.fit(demo)


def sinkhorn(demo, spec=SPEC, **kwargs):
    """Sinkhorn's reward of a demonstration."""
    size = demo["observation"].shape[-1]
    reward = SinkhornReward(size, spec, atoms=len(demo), **kwargs)
    return reward.fit(demo)


def rewards(module, batch):
    """The module's rewards of a batch, without the last dimension."""
    return module(batch.clone())["next", "intrinsic_reward"].squeeze(-1)
