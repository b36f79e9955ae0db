import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from giril_rl.errors import UserError
from giril_rl.rewards import ConstantReward, GenerativeReward
from giril_rl.transforms import BatchMeanReward, IntrinsicReward, ReturnScaling


def make_batch(reward, done=None):
    done = torch.zeros_like(reward, dtype=torch.bool) if done is None else done
    shape = reward.shape[:-1]
    return TensorDict({"next": {"reward": reward, "done": done}}, shape)


def loop(reward, done, gamma, reset, clip=10.0, eps=1e-8):
    """The baselines' VecNormalize, written as its loop over steps with all returns remembered."""
    running, seen, out = np.zeros(len(reward)), [], np.empty_like(reward)
    for t in range(reward.shape[1]):
        running = gamma * running + reward[:, t]
        seen.extend(running)
        # 1e-4 values of mean 0 and variance 1, and those seen
        weight = 1e-4 + len(seen)
        mean = np.sum(seen) / weight
        var = (1e-4 * (1 + mean**2) + np.sum((np.array(seen) - mean) ** 2)) / weight
        out[:, t] = np.clip(reward[:, t] / np.sqrt(var + eps), -clip, clip)
        if reset == "done":
            running = np.where(done[:, t], 0.0, running)
    return out


@pytest.mark.parametrize("reset", ["never", "done"])
@pytest.mark.parametrize("gamma", [0.0, 0.9, 0.99])
def test_against_a_loop_and_carried_across_batches(reset, gamma):
    rng = np.random.default_rng(0)
    reward = rng.normal(0.5, 1, (4, 300)).astype(np.float32)
    done = rng.random((4, 300)) < 0.05
    expected = loop(reward.astype(np.float64), done, gamma, reset)
    data = make_batch(torch.tensor(reward)[..., None], torch.tensor(done)[..., None])
    whole = ReturnScaling(gamma, reset=reset)
    np.testing.assert_allclose(
        whole(data.clone())["next", "reward"][..., 0], expected, rtol=1e-5, atol=1e-6
    )
    halves = ReturnScaling(gamma, reset=reset)
    parts = [halves(data[:, :131].clone()), halves(data[:, 131:].clone())]
    both = torch.cat([part["next", "reward"] for part in parts], 1)
    np.testing.assert_allclose(both[..., 0], expected, rtol=1e-5, atol=1e-6)
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(value, halves.state_dict()[name])


def test_no_mean_subtraction_and_clip():
    data = make_batch(torch.full((2, 50, 1), 3.0))
    scaled = ReturnScaling(0.9)(data.clone())["next", "reward"]
    assert (scaled > 0).all() and scaled.max() <= 10.0
    assert ReturnScaling(0.0, clip=None)(data.clone())["next", "reward"].max() > 10.0
    assert ReturnScaling(0.9, clip=0.5)(data.clone())["next", "reward"].max() == 0.5


def test_permuting_environments_permutes_rewards():
    data, order = make_batch(torch.randn(4, 60, 1)), torch.tensor([3, 1, 0, 2])
    plain = ReturnScaling()(data.clone())["next", "reward"]
    torch.testing.assert_close(ReturnScaling()(data[order])["next", "reward"], plain[order])


def test_causal():
    data = make_batch(torch.randn(2, 40, 1))
    changed = data.clone()
    changed["next", "reward"][:, 30:] = 1e6
    a, b = (ReturnScaling(clip=None)(d.clone())["next", "reward"] for d in (data, changed))
    torch.testing.assert_close(a[:, :30], b[:, :30], rtol=1e-4, atol=0)


def test_time_dim_flat_batches_and_event_dimensions():
    reward = torch.randn(3, 20, 1)
    expected = ReturnScaling()(make_batch(reward.clone()))["next", "reward"]
    swapped = make_batch(reward.transpose(0, 1).contiguous())
    out = ReturnScaling(time_dim=0)(swapped)["next", "reward"]
    torch.testing.assert_close(out.transpose(0, 1), expected)
    flat = ReturnScaling()(make_batch(reward[0].clone()))["next", "reward"]
    one = ReturnScaling()(make_batch(reward[:1].clone()))["next", "reward"]
    torch.testing.assert_close(flat, one[0])
    # three agents of one environment count as three returns
    agents = TensorDict({"next": {"reward": reward.transpose(0, 1)}}, [20])
    out = ReturnScaling()(agents)["next", "reward"]
    torch.testing.assert_close(out.transpose(0, 1), expected)


@pytest.mark.parametrize("reset", ["never", "done"])
@pytest.mark.parametrize("group", [None, "agent"])
def test_env_equals_batch(counter_env, policy, group, reset):
    key = "reward" if group is None else (group, "reward")
    path = ("next", "reward") if group is None else ("next", group, "reward")
    env = TransformedEnv(counter_env(group=group), ReturnScaling(reward_key=key, reset=reset))
    in_env = env.rollout(150, policy(group), break_when_any_done=False)[path]
    base = counter_env(group=group).rollout(150, policy(group), break_when_any_done=False)
    in_batch = ReturnScaling(reward_key=key, reset=reset)(base)[path]
    torch.testing.assert_close(in_env, in_batch, rtol=1e-6, atol=1e-6)
    assert in_env.std() > 0


@pytest.mark.parametrize("reset", ["never", "done"])
def test_whole_stack_env_equals_batch(counter_env, policy, reset):
    reward = GenerativeReward.for_vectors(2, counter_env().action_spec, normalise="raw")

    def stack():
        return Compose(IntrinsicReward(reward), BatchMeanReward(), ReturnScaling(reset=reset))

    env = TransformedEnv(counter_env(), stack())
    check_env_specs(env)
    env = TransformedEnv(counter_env(), stack())
    in_env = env.rollout(50, policy(), break_when_any_done=False)
    batch = stack()(counter_env().rollout(50, policy(), break_when_any_done=False))
    for name in ("reward", "extrinsic_reward"):
        torch.testing.assert_close(in_env["next", name], batch["next", name], rtol=1e-6, atol=1e-6)
    assert env.reward_key == "reward"


def test_manual_reset_of_some_environments(counter_env, policy):
    for reset, expected in (("done", [1.99, 0.0, 1.99]), ("never", [1.99] * 3)):
        scaling = ReturnScaling(0.99, reset=reset)
        env = TransformedEnv(counter_env(reward=lambda t: 1.0), scaling)
        data = env.rollout(2, policy())[:, -1]["next"].exclude("reward")
        assert scaling.running_return.tolist() == pytest.approx([1.99] * 3)
        data["_reset"] = torch.tensor([[False], [True], [False]])
        env.reset(data)
        assert scaling.running_return.tolist() == pytest.approx(expected)
        env.reset()
        assert scaling.running_return.tolist() == (
            [0.0] * 3 if reset == "done" else pytest.approx(expected)
        )


@pytest.mark.parametrize("how", ["eval", "freeze"])
def test_frozen(how):
    scaling = ReturnScaling(0.9, clip=None)
    scaling(make_batch(torch.randn(4, 50, 1)))
    getattr(scaling, how)()
    before = {name: value.clone() for name, value in scaling.state_dict().items()}
    deviation = (before["m2"] / before["count"] + 1e-8).sqrt().float()
    for shape in [(7,), (2, 3), ()]:
        reward = torch.randn(*shape, 1)
        out = scaling(make_batch(reward.clone()))["next", "reward"]
        torch.testing.assert_close(out, reward / deviation)
    for name, value in scaling.state_dict().items():
        assert torch.equal(value, before[name])


def test_frozen_in_an_env(counter_env):
    scaling = ReturnScaling(0.9, reset="done")
    env = TransformedEnv(counter_env(), scaling)
    env.rollout(5, break_when_any_done=False)
    assert scaling.count > 14
    before = {name: value.clone() for name, value in scaling.state_dict().items()}
    scaling.freeze()
    env.rollout(5, break_when_any_done=False)
    assert all(torch.equal(v, before[k]) for k, v in scaling.state_dict().items())
    scaling.unfreeze()
    env.rollout(5, break_when_any_done=False)
    assert scaling.count > 29


def test_frozen_before_anything_was_learned_is_refused():
    stack = Compose()
    stack.append(ReturnScaling())
    with pytest.raises(UserError, match="learned nothing"):
        stack(make_batch(torch.randn(2, 5, 1)))


def test_state_round_trip_into_a_fresh_instance():
    data = make_batch(torch.randn(4, 30, 1))
    one, two = ReturnScaling(), ReturnScaling()
    one(data[:, :10].clone())
    two.load_state_dict(one.state_dict())
    assert two.running_return.shape == (4,)
    rest = data[:, 10:]
    expected = one(rest.clone())["next", "reward"]
    assert torch.equal(two(rest.clone())["next", "reward"], expected)
    composed = Compose(BatchMeanReward(), ReturnScaling())
    composed.load_state_dict({f"transforms.1.{k}": v for k, v in one.state_dict().items()})
    assert torch.equal(composed[1].running_return, one.running_return)


def test_serial_env_outside_works_inside_refuses(counter_env, policy):
    env = TransformedEnv(SerialEnv(2, lambda: counter_env(3)), ReturnScaling())
    check_env_specs(env)
    env = TransformedEnv(SerialEnv(2, lambda: counter_env(3)), ReturnScaling())
    data = env.rollout(20, policy(), break_when_any_done=False)
    assert env.transform.running_return.shape == (6,)
    base = SerialEnv(2, lambda: counter_env(3)).rollout(20, policy(), break_when_any_done=False)
    expected = ReturnScaling()(base)["next", "reward"]
    torch.testing.assert_close(data["next", "reward"], expected, rtol=1e-6, atol=1e-6)
    with pytest.raises(UserError, match="outside"):
        SerialEnv(2, lambda: TransformedEnv(counter_env(1), ReturnScaling())).reset()


def test_no_gradient_and_dtype():
    reward = torch.randn(2, 5, 1, dtype=torch.float64, requires_grad=True)
    out = ReturnScaling()(make_batch(reward))["next", "reward"]
    assert not out.requires_grad and out.dtype == torch.float64


@pytest.mark.parametrize(
    "kwargs", [{"gamma": 1.1}, {"gamma": -0.1}, {"reset": "sometimes"}, {"clip": 0}, {"eps": -1}]
)
def test_bad_arguments(kwargs):
    with pytest.raises(UserError, match=next(iter(kwargs))):
        ReturnScaling(**kwargs)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e200])
def test_a_reward_that_is_not_finite_is_refused_and_not_learned(value):
    reward = torch.randn(3, 20, 1, dtype=torch.float64)
    scaling, twin = ReturnScaling(), ReturnScaling()
    for one in (scaling, twin):
        one(make_batch(reward))
    bad = reward.clone()
    bad[1, 18] = bad[2, 17] = value
    sentence = "too large" if value == 1e200 else f"is {value} in environment 2 at step 17 of"
    with pytest.raises(UserError, match=sentence):
        scaling(make_batch(bad))
    for name, expected in twin.state_dict().items():
        assert torch.equal(scaling.state_dict()[name], expected)
    out = scaling(make_batch(reward))["next", "reward"]
    assert torch.equal(out, twin(make_batch(reward))["next", "reward"])


def test_the_place_of_a_reward_that_is_not_finite(counter_env):
    agents = torch.zeros(4, 5, 2, 1)
    agents[3, 2, 1] = float("nan")
    with pytest.raises(UserError, match="in environment 3 at step 2 of"):
        ReturnScaling()(make_batch(agents).auto_batch_size_(2))
    agents[:, 2] = float("nan")
    with pytest.raises(UserError, match="in every environment at step 2 of"):
        ReturnScaling()(make_batch(agents).auto_batch_size_(2))
    spoilt = counter_env(reward=lambda t: torch.tensor([[0.0], [torch.inf], [0.0]]))
    with pytest.raises(UserError, match="is inf in environment 1 at this step"):
        TransformedEnv(spoilt, ReturnScaling()).rollout(2)


@pytest.mark.parametrize("make", [ReturnScaling, BatchMeanReward])
def test_split_trajectories_are_refused(counter_env, make):
    kinds = {"auto_register_policy_transforms": False, "split_trajs": True}
    collector = Collector(
        counter_env(), frames_per_batch=24, total_frames=24, postproc=make(), **kinds
    )
    with pytest.raises(UserError, match="split_trajs=False"):
        next(iter(collector))
    collector.shutdown()
    split = make_batch(torch.ones(2, 3, 1))
    split["collector", "mask"] = torch.tensor([[True] * 3, [True, False, False]])
    scaling = ReturnScaling(clip=None)
    scaling(make_batch(torch.randn(2, 5, 1)))
    deviation = (scaling.m2 / scaling.count + 1e-8).sqrt().float()
    scaled = scaling.freeze()(split)["next", "reward"]
    torch.testing.assert_close(scaled, torch.ones(2, 3, 1) / deviation)


class Odd(Transform):
    """Stands for an environment that breaks its word."""

    def __init__(self, reward):
        super().__init__()
        self.reward = reward

    def _step(self, tensordict, next_tensordict):
        if self.reward is None:
            return next_tensordict.exclude("reward")
        return next_tensordict.set("reward", self.reward)


@pytest.mark.parametrize("make", [ReturnScaling, BatchMeanReward, IntrinsicReward])
def test_a_reward_that_is_not_there_or_not_of_its_specs_shape(counter_env, make):
    transform = make(ConstantReward()) if make is IntrinsicReward else make()
    for missing in (TensorDict({"next": {}}, [2]), TensorDict({"next": {"reward": None}}, [2])):
        with pytest.raises(UserError, match="no reward under"):
            transform(missing)
    for reward, sentence in (
        (None, "no reward under"),
        (torch.zeros(3, 3), r"\(3, 3\) where its spec says \(3, 1\)"),
        (torch.zeros(3), r"\(3,\) where its spec says \(3, 1\)"),
    ):
        with pytest.raises(UserError, match=sentence):
            TransformedEnv(counter_env(), Compose(Odd(reward), transform.clone())).rollout(1)


def test_another_number_of_environments_is_refused():
    scaling = ReturnScaling()
    scaling(make_batch(torch.randn(4, 5, 1)))
    with pytest.raises(UserError, match=r"4 environments and the batch has 3"):
        scaling(make_batch(torch.randn(3, 5, 1)))
    with pytest.raises(UserError, match="next"):
        scaling(TensorDict(batch_size=[3]))
