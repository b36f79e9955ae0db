import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.collectors.utils import split_trajectories
from torchrl.envs import Compose, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from giril_rl.errors import UserError
from giril_rl.rewards import ConstantReward, GenerativeReward
from giril_rl.transforms import IntrinsicReward


def rollout(env, policy, steps=9):
    return env.rollout(steps, policy, break_when_any_done=False)


def expected_reward(batch):
    s, following = batch["observation"], batch["next", "observation"]
    return 1000 * s[..., :1] + 100 * s[..., 1:] + batch["action"] + 10_000 * following[..., 1:]


def generative(env, group=None, keys=None, **kwargs):
    more = {} if keys is None else {"in_keys": keys(group)}
    reward = GenerativeReward.for_vectors(2, env.action_spec, **more, **kwargs)
    reward.scaler.fit(torch.tensor([[0.0, 0.0], [2.0, 5.0]]))
    return reward


def test_alignment_in_env_and_batch(counter_env, policy, telling):
    batch = IntrinsicReward(telling())(rollout(counter_env(), policy()))
    env = TransformedEnv(counter_env(), IntrinsicReward(telling()))
    in_env = rollout(env, policy())
    for data in (batch, in_env):
        assert torch.equal(data["next", "reward"], expected_reward(data))
        s, following = data["observation"][..., 1], data["next", "observation"][..., 1]
        # also where an episode ends: the terminal observation, not the reset one
        assert data["next", "done"].any() and torch.equal(following, s + 1)
        assert torch.equal(data["next", "extrinsic_reward"].squeeze(-1), following)
        assert ("next", "intrinsic_reward") not in data.keys(True)
    torch.testing.assert_close(in_env["next", "reward"], batch["next", "reward"])


@pytest.mark.parametrize("group", [None, "agent"])
def test_nested_keys(counter_env, policy, telling, keys, group):
    reward_key = "reward" if group is None else (group, "reward")
    extrinsic = "true" if group is None else (group, "sub", "true")
    transform = IntrinsicReward(telling(group), reward_key=reward_key, extrinsic_key=extrinsic)
    env = TransformedEnv(counter_env(group=group), transform)
    check_env_specs(env)
    assert env.reward_keys == [reward_key]
    in_env = rollout(env, policy(group))
    batch = rollout(counter_env(group=group), policy(group))
    batch = IntrinsicReward(telling(group), reward_key=reward_key, extrinsic_key=extrinsic)(batch)
    for name in (reward_key, extrinsic):
        path = ("next", name) if isinstance(name, str) else ("next", *name)
        torch.testing.assert_close(in_env[path], batch[path])
    assert env.reset()[extrinsic].eq(0).all()


def test_specs_and_reward_key(counter_env, telling):
    env = TransformedEnv(counter_env(), IntrinsicReward(telling()))
    check_env_specs(env)
    assert env.reward_key == "reward"
    assert "extrinsic_reward" in env.observation_spec.keys(True)
    dropped = TransformedEnv(counter_env(), IntrinsicReward(telling(), extrinsic_key=None))
    check_env_specs(dropped)
    assert "extrinsic_reward" not in dropped.rollout(2)["next"].keys(True)


@pytest.mark.parametrize("outer", [True, False])
def test_serial_env(counter_env, policy, telling, outer):
    if outer:
        env = TransformedEnv(SerialEnv(2, lambda: counter_env(1)), IntrinsicReward(telling()))
    else:
        env = SerialEnv(2, lambda: TransformedEnv(counter_env(1), IntrinsicReward(telling())))
    check_env_specs(env)
    data = rollout(env, policy())
    assert data.shape == (2, 1, 9)
    assert torch.equal(data["next", "reward"], expected_reward(data))


def test_collector_postproc_over_several_batches(counter_env, policy, telling):
    collector = Collector(
        counter_env(),
        policy(),
        frames_per_batch=12,
        total_frames=48,
        postproc=IntrinsicReward(telling()),
        auto_register_policy_transforms=False,
    )
    for data in collector:
        assert data.shape == (3, 4)
        assert torch.equal(data["next", "reward"], expected_reward(data))
        true = data["next", "observation"][..., 1:]
        assert torch.equal(data["next", "extrinsic_reward"], true)
    collector.shutdown()


@pytest.mark.parametrize("garbage", [float("nan"), float("inf"), -1e9])
def test_true_reward_does_not_leak(counter_env, policy, garbage):
    reward = generative(counter_env())
    clean = rollout(TransformedEnv(counter_env(), IntrinsicReward(reward)), policy())
    spoilt = counter_env(reward=lambda t: garbage)
    spoilt_in_env = rollout(TransformedEnv(spoilt, IntrinsicReward(reward)), policy())
    batch = IntrinsicReward(reward)(rollout(counter_env(reward=lambda t: garbage), policy()))
    torch.testing.assert_close(spoilt_in_env["next", "reward"], clean["next", "reward"])
    torch.testing.assert_close(batch["next", "reward"], clean["next", "reward"])


@pytest.mark.parametrize("group", [None, "agent"])
def test_generative_env_equals_batch(counter_env, policy, keys, group):
    reward = generative(counter_env(group=group), group, keys)
    reward_key = "reward" if group is None else (group, "reward")
    path = ("next", "reward") if group is None else ("next", group, "reward")
    env = TransformedEnv(counter_env(group=group), IntrinsicReward(reward, reward_key=reward_key))
    in_env = rollout(env, policy(group))[path]
    batch = rollout(counter_env(group=group), policy(group))
    in_batch = IntrinsicReward(reward, reward_key=reward_key)(batch)[path]
    torch.testing.assert_close(in_env, in_batch, rtol=1e-6, atol=1e-6)
    assert in_env.std() > 0


def test_eval_mode_no_gradient_and_flags_restored(counter_env, policy):
    class Spy(nn.Module):
        def __init__(self):
            super().__init__()
            self.linear, self.frozen, self.seen = nn.Linear(2, 1), nn.Dropout(), []

        def forward(self, s):
            modes = (self.training, self.linear.training, torch.is_grad_enabled())
            self.seen.append(modes)
            return self.linear(s)

    spy = Spy()
    spy.frozen.eval()
    transform = IntrinsicReward(
        TensorDictModule(spy, [("next", "observation")], [("next", "intrinsic_reward")])
    )
    data = rollout(counter_env(), policy())
    relabelled = transform(data)
    assert spy.seen == [(False, False, False)]
    assert not relabelled["next", "reward"].requires_grad
    assert spy.training and spy.linear.training and not spy.frozen.training
    # Attaching it to an environment does not interfere with the module's training either.
    TransformedEnv(counter_env(), Compose(StepCounter(), transform)).rollout(3)
    assert spy.training and not spy.seen[-1][0]
    spy.eval()
    transform(data)
    assert not spy.training


def test_a_module_that_turns_gradients_on_is_detached():
    def reward(s):
        with torch.enable_grad():
            return (s * nn.Parameter(torch.ones(1))).sum(-1, keepdim=True)

    module = TensorDictModule(reward, [("next", "observation")], [("next", "intrinsic_reward")])
    data = TensorDict({"next": {"observation": torch.ones(4, 2), "reward": torch.zeros(4, 1)}}, [4])
    assert not IntrinsicReward(module)(data)["next", "reward"].requires_grad


def test_state_dict_and_to(counter_env):
    one, two = generative(counter_env(), seed=1), generative(counter_env(), seed=2)
    first, second = IntrinsicReward(one), IntrinsicReward(two)
    assert any(name.startswith("module.decoder") for name in first.state_dict())
    second.load_state_dict(first.state_dict())
    assert torch.equal(one.decoder[0].weight, two.decoder[0].weight)
    assert first.to(torch.float64).module.decoder[0].weight.dtype == torch.float64
    env = TransformedEnv(counter_env(), IntrinsicReward(generative(counter_env(), seed=3)))
    env.load_state_dict(second.state_dict())
    assert torch.equal(env.transform.module.decoder[0].weight, two.decoder[0].weight)


def test_reward_keeps_the_environments_dtype(counter_env, policy, telling):
    env = TransformedEnv(counter_env(dtype=torch.float64), IntrinsicReward(telling()))
    check_env_specs(env)
    assert rollout(env, policy())["next", "reward"].dtype == torch.float64


def test_module_with_its_own_out_key_leaves_nothing_behind(counter_env, policy, telling):
    data = rollout(counter_env(), policy())
    before = set(data.keys(True, True))
    data = IntrinsicReward(telling(out_key="mine"), extrinsic_key=None)(data)
    assert set(data.keys(True, True)) == before
    assert torch.equal(data["next", "reward"], expected_reward(data))


def test_demonstration_without_reward():
    data = TensorDict({"next": {"observation": torch.zeros(4, 2)}}, [4])
    out = IntrinsicReward(ConstantReward(), extrinsic_key=None)(data.clone())
    assert torch.equal(out["next", "reward"], torch.ones(4, 1))
    with pytest.raises(UserError, match="extrinsic_key=None"):
        IntrinsicReward(ConstantReward())(data)


def test_a_true_reward_that_is_kept_already_is_not_lost(counter_env, policy, telling):
    once = IntrinsicReward(telling())(rollout(counter_env(), policy()))
    with pytest.raises(UserError, match=r"\('next', 'extrinsic_reward'\) already"):
        IntrinsicReward(telling())(once)
    again = IntrinsicReward(ConstantReward(), extrinsic_key=None)(once)
    assert again["next", "reward"].eq(1).all()
    assert torch.equal(again["next", "extrinsic_reward"], once["next", "extrinsic_reward"])
    env = TransformedEnv(counter_env(), IntrinsicReward(telling()))
    start = env.rand_step(env.reset())
    env.step(start)  # What a step left there is replaced by the next one.
    with pytest.raises(UserError, match="'extrinsic_reward' already"):
        TransformedEnv(env, IntrinsicReward(telling())).rollout(1)
    with pytest.raises(UserError, match="'observation' already"):
        TransformedEnv(
            counter_env(), IntrinsicReward(telling(), extrinsic_key="observation")
        ).rollout(1)


def test_the_padding_of_split_trajectories_is_not_paid(counter_env, policy, telling):
    kinds = {"auto_register_policy_transforms": False, "split_trajs": True}
    collector = Collector(
        counter_env(),
        policy(),
        frames_per_batch=24,
        total_frames=24,
        postproc=IntrinsicReward(telling()),
        **kinds,
    )
    (data,) = collector
    collector.shutdown()
    real = data["collector", "mask"]
    assert not real.all()
    assert torch.equal(data[real]["next", "reward"], expected_reward(data[real]))
    assert data["next", "reward"][~real].eq(0).all()
    played = rollout(counter_env(2), policy())
    split = split_trajectories(played, done_key="done")
    paid = IntrinsicReward(ConstantReward())(split)
    assert paid["next", "reward"].sum() == played.numel() < split.numel()


def test_bad_inputs(counter_env, policy):
    with pytest.raises(UserError, match="TensorDictModule"):
        IntrinsicReward(nn.Linear(2, 1))
    with pytest.raises(UserError, match="one key only"):
        IntrinsicReward(TensorDictModule(lambda s: (s, s), ["observation"], ["a", "b"]))
    with pytest.raises(UserError, match="another key"):
        IntrinsicReward(ConstantReward(), extrinsic_key="reward")
    with pytest.raises(UserError, match="no reward 'prize'"):
        TransformedEnv(
            counter_env(), IntrinsicReward(ConstantReward(), reward_key="prize")
        ).rollout(1)
    two_values = TensorDictModule(lambda s: s, ["observation"], [("next", "intrinsic_reward")])
    with pytest.raises(UserError, match="one value per transition"):
        IntrinsicReward(two_values)(rollout(counter_env(), policy()))
        IntrinsicReward(two_values, extrinsic_key=None)(
            rollout(counter_env(), policy()).exclude(("next", "reward"))
        )
    with pytest.raises(UserError, match="next"):
        IntrinsicReward(ConstantReward())(TensorDict(batch_size=[3]))
    forgetful = ConstantReward()
    forgetful.forward = lambda tensordict: tensordict
    with pytest.raises(UserError, match="wrote no tensor"):
        IntrinsicReward(forgetful)(rollout(counter_env(), policy()))
