import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from giril_rl.errors import UserError
from giril_rl.transforms import BatchMeanReward, IntrinsicReward


def test_by_hand():
    reward = torch.tensor([[1.0, 2.0, 3.0], [3.0, 4.0, 8.0]]).unsqueeze(-1)
    data = BatchMeanReward()(TensorDict({"next": {"reward": reward}}, [2, 3]))
    assert data["next", "reward"].squeeze(-1).tolist() == [[2.0, 3.0, 5.5]] * 2
    data = TensorDict({"next": {"reward": reward.transpose(0, 1)}}, [3, 2])
    data = BatchMeanReward(time_dim=0)(data)
    assert data["next", "reward"].squeeze(-1).tolist() == [[2.0] * 2, [3.0] * 2, [5.5] * 2]


def test_flat_batch_is_one_environment():
    reward = torch.randn(5, 1)
    data = BatchMeanReward()(TensorDict({"next": {"reward": reward}}, [5]))
    assert torch.equal(data["next", "reward"], reward)


@pytest.mark.parametrize("group", [None, "agent"])
def test_env_equals_batch(counter_env, policy, telling, group):
    key = "reward" if group is None else (group, "reward")
    path = ("next", "reward") if group is None else ("next", group, "reward")

    def stack():
        return Compose(IntrinsicReward(telling(group), reward_key=key), BatchMeanReward(key))

    env = TransformedEnv(counter_env(group=group), stack())
    check_env_specs(env)
    in_env = env.rollout(9, policy(group), break_when_any_done=False)[path]
    base = counter_env(group=group).rollout(9, policy(group), break_when_any_done=False)
    in_batch = stack()(base)[path]
    torch.testing.assert_close(in_env, in_batch, rtol=1e-6, atol=1e-6)
    assert (in_batch == in_batch[:1]).all() and in_batch.std() > 0


def test_serial_env(counter_env, policy):
    env = TransformedEnv(SerialEnv(2, lambda: counter_env(3)), BatchMeanReward())
    check_env_specs(env)
    data = env.rollout(9, policy(), break_when_any_done=False)
    true = data["next", "observation"][..., 1:].mean((0, 1), keepdim=True)
    torch.testing.assert_close(data["next", "reward"], true.expand(2, 3, 9, 1))
    with pytest.raises(UserError, match="outside"):
        SerialEnv(2, lambda: TransformedEnv(counter_env(1), BatchMeanReward())).reset()


def test_values_do_not_share_memory():
    reward = torch.randn(3, 2, 1)
    data = BatchMeanReward()(TensorDict({"next": {"reward": reward}}, [3, 2]))
    data["next", "reward"][0, 0] = 99.0
    assert data["next", "reward"][1, 0] != 99.0
