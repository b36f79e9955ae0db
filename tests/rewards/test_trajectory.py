"""What every reward along time holds: the same numbers however time is cut, and refusals."""

import copy
from functools import partial

import gymnasium
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, GymEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs
from walks import demonstration, pwil, rewards, sinkhorn, walk

from giril_rl.envs import FixedHorizonEnv, GymVectorEnv
from giril_rl.errors import UserError
from giril_rl.rewards.controls import AffineReward
from giril_rl.rewards.trajectory import fresh_episodes
from giril_rl.runs.checkpoint import load_state, save_state
from giril_rl.transforms import IntrinsicReward

MADE = {"pwil": partial(pwil, horizon=12), "sinkhorn": partial(sinkhorn, iterations=20)}
every_reward = pytest.mark.parametrize("make", MADE.values(), ids=MADE)


def assert_equal(one, other):
    torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


def in_parts(reward, batch, *sizes):
    return torch.cat([rewards(reward, part) for part in batch.split(list(sizes), 1)], 1)


# Batches that follow time


@every_reward
def test_any_split_of_time_gives_the_same_numbers(make):
    demo, batch = demonstration(9), walk(3, 40)
    whole = rewards(make(demo), batch)
    assert whole.any(1).all()
    for sizes in ([1] * 40, [7, 26, 7], [39, 1]):
        assert_equal(in_parts(make(demo), batch, *sizes), whole)
    assert_equal(rewards(make(demo), batch.unsqueeze(0))[0], whole)
    assert rewards(make(demo), batch[:, :0]).shape == (3, 0)


@every_reward
def test_an_episode_does_not_depend_on_others(make):
    demo, batch = demonstration(9), walk(3, 40)
    whole, done = rewards(make(demo, **scaled(make)), batch), batch["next", "done"].squeeze(-1)
    for i in range(3):
        begin = 0
        for end in done[i].nonzero().flatten().tolist():
            alone = rewards(make(demo, **scaled(make)), batch[i : i + 1, begin : end + 1])
            assert_equal(alone[0], whole[i, begin : end + 1])
            begin = end + 1
    assert done.sum() > 3


def scaled(make):
    """A scale, where a reward would learn it from the first episode."""
    return {"scale": 2.0} if make is MADE["sinkhorn"] else {}


@every_reward
def test_a_state_dict_continues_in_the_middle_of_episodes(make, tmp_path):
    demo, batch = demonstration(9), walk(3, 40)
    whole = rewards(make(demo), batch)
    first = make(demo)
    rewards(first, batch[:, :17])
    save_state(tmp_path / "reward.safetensors", dict(first.state_dict()))
    other = make(demonstration(9, seed=7))
    rewards(other, walk(5, 3))  # Of other environments.
    other.load_state_dict(load_state(tmp_path / "reward.safetensors"))
    assert_equal(rewards(other, batch[:, 17:]), whole[:, 17:])


@every_reward
def test_an_environment_that_was_reset_in_between_begins_anew(make):
    demo, batch = demonstration(9), walk(3, 20, ends=0.0)
    batch["next", "done"][:, -1] = True
    kwargs = scaled(make)
    reward = make(demo, **kwargs)
    rewards(reward, walk(3, 5, seed=4, ends=0.0))
    assert reward.running.all()
    assert_equal(rewards(reward, batch), rewards(make(demo, **kwargs), batch))
    # Of one environment alone:
    reward, before = make(demo, **kwargs), walk(3, 5, seed=4, ends=0.0)
    rewards(reward, before)
    after = batch.clone()
    after["observation"][:2, 0] = before["next", "observation"][:2, -1]
    got = rewards(reward, after)
    assert_equal(got[2], rewards(make(demo, **kwargs), after)[2])
    together = make(demo, **kwargs)
    both = torch.cat([before, after], 1)[:2]
    assert_equal(got[:2], rewards(together, both)[:, 5:])


@every_reward
def test_a_separate_trajectory_leaves_the_running_episodes_alone(make):
    demo, batch, kwargs = demonstration(9), walk(3, 40), scaled(make)
    reward = make(demo, **kwargs)
    transform = Compose(IntrinsicReward(reward))
    first = transform(batch[:, :17].clone())["next", "reward"]
    state = copy.deepcopy(reward.state_dict())
    with fresh_episodes(transform):
        own = transform(demo.unsqueeze(0))["next", "reward"]
        assert torch.equal(transform(demo.unsqueeze(0))["next", "reward"], own)
    assert own.shape == (1, 9, 1)
    if make is MADE["sinkhorn"]:
        assert (own != 0).sum() > 1  # Each step's share.
    for name, value in reward.state_dict().items():
        assert torch.equal(value, state[name]), name
    with pytest.raises(UserError, match="in order of time"), reward.fresh_episodes():
        rewards(reward, walk(7, 3))
        rewards(reward, walk(7, 3).reshape(-1))
    second = transform(batch[:, 17:].clone())["next", "reward"]
    whole = rewards(make(demo, **kwargs), batch)
    assert_equal(torch.cat([first, second], 1).squeeze(-1), whole)


@every_reward
def test_fresh_episodes_are_cut_at_ends_and_episode_numbers(make):
    demo = demonstration(9)
    parts = [demonstration(length, seed) for length, seed in ((4, 2), (6, 3), (5, 4))]
    parts[0]["next", "done"][:] = False  # The first n steps of an episode have no end.
    data = torch.cat(parts)
    data["episode"] = torch.tensor([0] * 4 + [1] * 6 + [2] * 5)
    reward = make(demo, **scaled(make))
    with reward.fresh_episodes():
        whole = rewards(reward, data.unsqueeze(0))[0]
        assert_equal(whole, torch.cat([rewards(reward, part.unsqueeze(0))[0] for part in parts]))
    with reward.fresh_episodes(), pytest.raises(UserError, match="step 4 of environment 0"):
        rewards(reward, data.exclude("episode").unsqueeze(0))


@every_reward
def test_a_saved_reward_has_no_running_episodes(make, tmp_path):
    reward, batch = make(demonstration(9), **scaled(make)), walk(3, 10)
    expected = rewards(reward, batch)
    assert reward.running.any()
    folder = reward.save_pretrained(tmp_path / "reward")
    loaded = type(reward).from_pretrained(folder)
    assert len(loaded.running) == 0 and len(reward.running) == 3
    assert_equal(rewards(loaded, batch), expected)


# Refusals


@every_reward
def test_data_out_of_order_are_refused(make):
    reward, batch = make(demonstration(9)), walk(3, 10, ends=0.0)
    flat = r"needs batches \(environments, time\) in order of time, not of shape \(30,\): relabel"
    with pytest.raises(UserError, match=flat):
        rewards(reward, batch.reshape(30))
    order = r"step 1 of environment 0 does not begin where step 0 led: give whole trajectories"
    with pytest.raises(UserError, match=order):
        rewards(reward, batch.reshape(30)[torch.randperm(30)].reshape(3, 10))
    with pytest.raises(UserError, match=order):
        rewards(reward, batch[:, ::2])
    rewards(reward, batch)
    with pytest.raises(UserError, match=r"episodes of 3 environments, and the batch has 2: give"):
        rewards(reward, batch[:2])
    with pytest.raises(UserError, match=r"the batch has no \('next', 'done'\)"):
        rewards(reward, batch.exclude(("next", "done")))
    ended = walk(3, 1, ends=1.0)
    rewards(reward, ended)
    assert rewards(reward, batch[:2]).shape == (2, 10)  # Nothing runs: other environments may come.


@every_reward
def test_a_replay_buffer_and_split_trajectories_are_refused(make):
    transform, batch = IntrinsicReward(make(demonstration(9))), walk(3, 10)
    storage = LazyTensorStorage(30)
    buffer = TensorDictReplayBuffer(storage=storage, transform=transform, batch_size=8)
    buffer.extend(batch.reshape(-1))
    with pytest.raises(UserError, match="before a replay buffer takes them"):
        buffer.sample()
    batch["collector", "mask"] = torch.ones(3, 10, dtype=torch.bool)
    with pytest.raises(UserError, match=r"split trajectories .* split_trajs=False\.$"):
        transform(batch)


@every_reward
def test_a_place_inside_a_worker_is_refused(make):
    reward = make(demonstration(9))
    with pytest.raises(
        UserError, match="inside a worker sees one environment only: put it outside"
    ):
        SerialEnv(2, lambda: TransformedEnv(GymEnv("Pendulum-v1"), IntrinsicReward(reward))).reset()


def test_a_wrong_number_of_keys_is_refused():
    with pytest.raises(UserError, match=r"in_keys for 3 entries such as \['observation'"):
        pwil(demonstration(4), horizon=3, spec=None, in_keys=["observation", "action"])


# Environments


def pendulum_demonstration():
    env = GymEnv("Pendulum-v1")
    env.set_seed(3)
    return env.rollout(50).exclude(("next", "reward"))


def made_for_pendulum(name):
    demo = pendulum_demonstration()
    spec = GymEnv("Pendulum-v1").action_spec
    kwargs = {"horizon": 30} if name == "pwil" else {"iterations": 20}
    return {"pwil": pwil, "sinkhorn": sinkhorn}[name](demo, spec=spec, **kwargs)


def unpaid(batch):
    """The batch as the environment gave it."""
    batch = batch.clone()
    batch["next", "reward"] = batch["next", "extrinsic_reward"]
    return batch.exclude(("next", "extrinsic_reward"), "extrinsic_reward")


@pytest.mark.parametrize("name", MADE)
def test_a_single_environment_of_torchrl(name):
    reward = made_for_pendulum(name)
    env = TransformedEnv(GymEnv("Pendulum-v1"), IntrinsicReward(copy.deepcopy(reward)))
    check_env_specs(env)
    env.transform.module.load_state_dict(reward.state_dict())
    data = env.rollout(230, break_when_any_done=False)
    assert data.shape == (230,) and data["next", "done"].sum() == 1
    again = IntrinsicReward(reward)(unpaid(data).unsqueeze(0))[0]
    assert_equal(again["next", "reward"], data["next", "reward"])
    assert data["next", "reward"].any()


@pytest.mark.parametrize("name", MADE)
def test_a_serial_environment_whose_episodes_end_at_different_times(name):
    reward = made_for_pendulum(name)
    limits = [partial(GymEnv, "Pendulum-v1", max_episode_steps=steps) for steps in (20, 33)]
    env = TransformedEnv(SerialEnv(2, limits), IntrinsicReward(copy.deepcopy(reward)))
    data = env.rollout(70, break_when_any_done=False)
    assert data["next", "done"].sum((1, 2)).tolist() == [3, 2]
    again = IntrinsicReward(reward)(unpaid(data))
    assert_equal(again["next", "reward"], data["next", "reward"])


def balance(observation):
    return (observation[..., 2] + observation[..., 3] > 0).long()


def cartpole(name):
    env = GymVectorEnv(lambda: gymnasium.make("CartPole-v1"), 1, seed=5)
    demo = env.rollout(60, TensorDictModule(balance, ["observation"], ["action"]))[0]
    kwargs = {"horizon": 40} if name == "pwil" else {"iterations": 20}
    return {"pwil": pwil, "sinkhorn": sinkhorn}[name](demo, spec=env.action_spec, **kwargs)


@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize("name", MADE)
def test_our_environments_in_a_collector_and_a_checkpoint_in_mid_episode(name, fixed, tmp_path):
    """Steps in an environment, batches of a collector, and one that is stopped and resumed."""

    def make_env():
        kind = FixedHorizonEnv if fixed else GymVectorEnv
        return kind(lambda: gymnasium.make("CartPole-v1"), 3, seed=0, max_episode_steps=50)

    class Alternate(torch.nn.Module):
        """Pushes to one side, and falls."""

        def forward(self, observation):
            return (observation[..., 0] > -0.1).long()

    policy = TensorDictModule(Alternate(), ["observation"], ["action"])

    def collect(env, frames):
        numbers = {"frames_per_batch": 3 * 8, "total_frames": 3 * frames}
        return Collector(env, policy, auto_register_policy_transforms=False, **numbers)

    reward = cartpole(name)
    transform = IntrinsicReward(copy.deepcopy(reward))
    batches = [transform(batch.clone()) for batch in collect(make_env(), 80)]
    whole = torch.cat([batch["next", "reward"] for batch in batches], 1)
    played = torch.cat(batches, 1)
    ends = played["next", "done"].sum()
    assert whole.any() and (ends == 3 if fixed else ends > 6)
    if fixed:
        led, onward = played["next", "observation"], played["next", "following_observation"]
        assert (led != onward).any(-1).sum() > 6  # Hidden resets.
    else:
        env = TransformedEnv(make_env(), IntrinsicReward(copy.deepcopy(reward)))
        stepped = torch.cat(list(collect(env, 80)), 1)
        assert_equal(stepped["next", "reward"], whole)

    env, first = make_env(), IntrinsicReward(copy.deepcopy(reward))
    parts = [first(batch.clone())["next", "reward"] for batch in collect(env, 40)]
    assert first.module.running.any()
    save_state(tmp_path / "transform.safetensors", dict(first.state_dict()))
    resumed, second = make_env(), IntrinsicReward(cartpole(name))
    assert resumed.restore_simulator(env.simulator_state())
    second.load_state_dict(load_state(tmp_path / "transform.safetensors"))
    parts += [second(batch.clone())["next", "reward"] for batch in collect(resumed, 40)]
    assert_equal(torch.cat(parts, 1), whole)
    if fixed:  # TorchRL's own steps, which a transform inside takes, know of no hidden resets.
        return
    resumed, inside = make_env(), IntrinsicReward(cartpole(name))
    assert resumed.restore_simulator(env.simulator_state())
    inside.load_state_dict(load_state(tmp_path / "transform.safetensors"))
    rest = list(collect(TransformedEnv(resumed, inside), 40))
    assert_equal(torch.cat([batch["next", "reward"] for batch in rest], 1), whole[:, 40:])


def test_a_control_made_of_it_follows_time_too():
    demo, batch = demonstration(9), walk(3, 40)
    negated = IntrinsicReward(AffineReward(pwil(demo, horizon=12), scale=-1.0))
    paid = torch.cat([negated(part.clone())["next", "reward"] for part in batch.split(9, 1)], 1)
    assert_equal(-paid.squeeze(-1), rewards(pwil(demo, horizon=12), batch))
    assert negated.along_time


def test_without_actions_in_an_environment():
    demo = pendulum_demonstration()
    reward = pwil(demo, horizon=30, spec=None)
    env = TransformedEnv(GymEnv("Pendulum-v1"), IntrinsicReward(copy.deepcopy(reward)))
    data = env.rollout(40)
    again = rewards(reward, unpaid(data).unsqueeze(0))
    assert_equal(again[0], data["next", "reward"].squeeze(-1))
