"""Outside a ParallelEnv and as a collector's postproc, on a Gymnasium task with one-hot actions."""

from functools import partial

import torch
from torchrl.collectors import Collector
from torchrl.envs import Compose, GymEnv, ParallelEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from giril_rl.rewards import GenerativeReward
from giril_rl.transforms import BatchMeanReward, IntrinsicReward, ReturnScaling


def test_parallel_env_env_equals_batch():
    parallel = ParallelEnv(2, partial(GymEnv, "CartPole-v1"))
    reward = GenerativeReward.for_vectors(4, parallel.action_spec, normalise="raw", clamp=False)
    scaling = ReturnScaling(reset="done", clip=None)
    mean = BatchMeanReward()
    env = TransformedEnv(parallel, Compose(IntrinsicReward(reward), mean, scaling))
    try:
        check_env_specs(env)
        scaling.load_state_dict(ReturnScaling().state_dict())
        data = env.rollout(60, break_when_any_done=False)
        assert data.shape == (2, 60) and data["next", "done"].any()
        raw = data.clone()
        raw["next", "reward"] = raw["next", "extrinsic_reward"]
        del raw["next", "extrinsic_reward"]
        stack = Compose(
            IntrinsicReward(reward), BatchMeanReward(), ReturnScaling(reset="done", clip=None)
        )
        again = stack(raw)
        torch.testing.assert_close(
            again["next", "reward"], data["next", "reward"], rtol=1e-5, atol=1e-6
        )
        assert torch.equal(data["next", "extrinsic_reward"], torch.ones(2, 60, 1))

        seen = 0
        stack = Compose(IntrinsicReward(reward), ReturnScaling())
        collector = Collector(parallel, frames_per_batch=40, total_frames=120, postproc=stack)
        for batch in collector:
            assert torch.equal(batch["next", "extrinsic_reward"], torch.ones(2, 20, 1))
            assert batch["next", "reward"].shape == (2, 20, 1)
            seen += batch.numel()
        assert seen == 120 and stack[1].count > 119
    finally:
        env.close(raise_if_closed=False)
