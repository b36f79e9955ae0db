import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import check_env_specs

from giril_rl.errors import UserError
from giril_rl.rewards import ConstantReward
from giril_rl.transforms import IntrinsicReward, ReturnScaling, WeightedReward


def rollout(env, policy, steps=9):
    return env.rollout(steps, policy, break_when_any_done=False)


def step_reward():
    """Pays the step that the counter environment shows next."""
    return TensorDictModule(
        lambda following: following[..., 1:], [("next", "observation")], ["paid"]
    )


def stack():
    """0.5 times the step paid, 0.3 times a constant, 0.2 times the true reward."""
    return Compose(
        IntrinsicReward(step_reward()),
        IntrinsicReward(ConstantReward(10.0), extrinsic_key="first"),
        WeightedReward({"first": 0.5, "reward": 0.3, "extrinsic_reward": 0.2}),
    )


def test_several_rewards_with_strengths(counter_env, policy):
    base = rollout(counter_env(reward=lambda t: -t), policy())
    batch = stack()(base.clone())
    env = TransformedEnv(counter_env(reward=lambda t: -t), stack())
    check_env_specs(env)
    in_env = rollout(env, policy())
    step = base["next", "observation"][..., 1:]
    for data in (batch, in_env):
        expected = 0.5 * step + 0.3 * 10.0 + 0.2 * -step
        torch.testing.assert_close(data["next", "reward"], expected)
        assert torch.equal(data["next", "first"], step)
        assert torch.equal(data["next", "extrinsic_reward"], -step)
    assert env.reward_key == "reward"


def test_after_scaling(counter_env, policy):
    parts = [IntrinsicReward(step_reward()), ReturnScaling()]
    data = Compose(*parts, WeightedReward({"reward": 2.0, "extrinsic_reward": -1.0}))(
        rollout(counter_env(), policy())
    )
    alone = Compose(IntrinsicReward(step_reward()), ReturnScaling())(
        rollout(counter_env(), policy())
    )
    expected = 2 * alone["next", "reward"] - alone["next", "extrinsic_reward"]
    torch.testing.assert_close(data["next", "reward"], expected)


@pytest.mark.parametrize("group", ["agent", ("deep", "agent")])
def test_nested_keys(counter_env, policy, group):
    if isinstance(group, tuple):
        batch = TensorDict({"next": {"deep": {"agent": {"a": torch.ones(3, 1)}}}}, [3])
        out = WeightedReward({(*group, "a"): 3.0}, reward_key=(*group, "b"))(batch)
        assert torch.equal(out["next", *group, "b"], torch.full((3, 1), 3.0))
        return
    transform = WeightedReward({(group, "reward"): 3.0}, reward_key=(group, "reward"))
    env = TransformedEnv(counter_env(group=group), transform)
    check_env_specs(env)
    data = rollout(env, policy(group))
    step = data["next", group, "observation"][..., 1:]
    assert torch.equal(data["next", group, "reward"], 3 * step)


def test_an_environment_of_several_rewards_is_left_with_one(counter_env, policy):
    class Second(Transform):
        """Adds a second reward, as an environment of several objectives has it."""

        def _step(self, tensordict, next_tensordict):
            reward = next_tensordict["reward"]
            return next_tensordict.set("second", torch.full_like(reward, 7.0))

        def transform_reward_spec(self, reward_spec):
            reward_spec["second"] = reward_spec["reward"].clone()
            return reward_spec

    weights = {"reward": 1.0, "second": 0.5}
    env = TransformedEnv(counter_env(), Compose(Second(), WeightedReward(weights)))
    check_env_specs(env)
    assert env.reward_keys == ["reward"] and "second" in env.observation_spec.keys()
    assert env.reset()["second"].eq(0).all()
    data = rollout(env, policy())
    assert torch.equal(data["next", "reward"], data["next", "observation"][..., 1:] + 3.5)
    fresh = WeightedReward(weights, reward_key="total")
    env = TransformedEnv(counter_env(), Compose(Second(), fresh))
    check_env_specs(env)
    assert env.reward_keys == ["total"]


def test_weight_zero_is_not_read_and_weights_may_change():
    batch = TensorDict({"next": {"reward": torch.ones(2, 1), "bad": torch.full((2, 1), torch.nan)}})
    transform = WeightedReward({"reward": 2.0, "bad": 0.0, "missing": 0.0})
    assert torch.equal(transform(batch.clone())["next", "reward"], torch.full((2, 1), 2.0))
    transform.weights["reward"] = 0.0
    assert torch.equal(transform(batch.clone())["next", "reward"], torch.zeros(2, 1))


def test_dtype_of_the_reward_is_kept(counter_env):
    weights = {"reward": 1.0, "extrinsic_reward": 1.0}
    parts = IntrinsicReward(ConstantReward(2.0)), WeightedReward(weights)
    env = TransformedEnv(counter_env(dtype=torch.float64), Compose(*parts))
    check_env_specs(env)
    assert env.rollout(2)["next", "reward"].dtype == torch.float64


def test_bad_inputs(counter_env):
    with pytest.raises(UserError, match="no weights"):
        WeightedReward({})
    with pytest.raises(UserError, match="'reward' is nan"):
        WeightedReward({"reward": float("nan")})
    transform = WeightedReward({"reward": 1.0, "prize": 1.0})
    with pytest.raises(UserError, match="next"):
        transform(TensorDict(batch_size=[2]))
    with pytest.raises(UserError, match="'prize'"):
        transform(TensorDict({"next": {"reward": torch.ones(2, 1)}}, [2]))
    with pytest.raises(UserError, match=r"\(2, 3\)"):
        rewards = {"reward": torch.ones(2, 1), "prize": torch.ones(2, 3)}
        transform(TensorDict({"next": rewards}, [2]))
    with pytest.raises(UserError, match="no 'prize'"):
        TransformedEnv(counter_env(), transform).reward_spec  # noqa: B018
    with pytest.raises(UserError, match="all weights are 0"):
        WeightedReward({"a": 0.0})(TensorDict({"next": {"b": torch.ones(2, 1)}}, [2]))
