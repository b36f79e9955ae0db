import pytest
import torch
from tensordict import TensorDict
from torch._inductor.exc import InductorError
from torchrl.data import Bounded
from torchrl.envs import Compose

from giril_rl.rewards import GenerativeReward
from giril_rl.transforms import BatchMeanReward, IntrinsicReward, ReturnScaling, WeightedReward


def batch(envs=4, steps=6):
    observation, reward = torch.randn(envs, steps, 2), torch.randn(envs, steps, 1)
    following = {"observation": observation + 0.1, "reward": reward}
    entries = {"observation": observation, "action": torch.rand(envs, steps, 1), "next": following}
    return TensorDict(entries, [envs, steps])


def make(reward):
    weighted = WeightedReward({"reward": 0.8, "extrinsic_reward": 0.2})
    return Compose(IntrinsicReward(reward), BatchMeanReward(), ReturnScaling(), weighted)


@pytest.mark.parametrize("backend", ["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_one_graph_with_the_same_numbers(backend):
    """The whole stack is captured without a break, and goes on learning from batch to batch."""
    torch._dynamo.reset()
    spec = Bounded(-1, 1, shape=(1,))
    reward = GenerativeReward.for_vectors(2, spec, hidden=(8,), normalise="demo_range")
    batches = [batch() for _ in range(3)]
    reward.scaler.fit(batches[0]["observation"])
    plain, compiled = make(reward), torch.compile(make(reward), backend=backend, fullgraph=True)
    for data in batches:
        expected = plain(data.clone())["next", "reward"]
        try:
            out = compiled(data.clone())["next", "reward"]
        except InductorError as error:
            pytest.skip(f"no compiler for torch.compile here: {error}")
        torch.testing.assert_close(out, expected, rtol=1e-5, atol=1e-6)
    before = {name: value.clone() for name, value in compiled.state_dict().items()}
    spoilt = batch()
    spoilt["observation"][1, 3] = float("nan")
    assert compiled(spoilt)["next", "reward"].isnan().all()  # A graph cannot refuse it.
    assert all(torch.equal(value, before[name]) for name, value in compiled.state_dict().items())
