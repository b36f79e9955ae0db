"""PPO on frames: advantages without a second pass, exact resumption, whole games in the log."""

import pytest
import torch
from short_runs import Killed, rows, stopped
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.utils._pytree import tree_flatten
from torchrl.envs import Compose
from torchrl.objectives.value import GAE

from giril_rl.config.schema import PPOConfig
from giril_rl.envs import AtariEnv
from giril_rl.policies import PixelActorCritic, make_agent
from giril_rl.rewards import GenerativeReward
from giril_rl.runs.interrupt import Interrupted
from giril_rl.runs.run import Run
from giril_rl.training.loop import train_policy
from giril_rl.training.ppo import PPO
from giril_rl.transforms import BatchMeanReward, IntrinsicReward, ReturnScaling

GAMMA, LMBDA = 0.9, 0.8


def config(**kwargs):
    small = {"num_envs": 2, "rollout": 16, "minibatch": 16, "epochs": 1, "lr": 1e-3}
    atari = {"clip_value": True, "entropy_coef": 0.01, "normalise_observations": False}
    return PPOConfig(**{**small, **atari, "checkpoint_every": 64, **kwargs})


# One update


def frames(*batch):
    return torch.randint(256, (*batch, 4, 84, 84), dtype=torch.uint8)


def collected(agent, num_envs=3, time=6):
    """A batch of whole transitions; each episode's last observation is shown nowhere else."""
    shown = frames(num_envs, time + 1)
    data = agent.acting()(TensorDict({"observation": shown[:, :-1]}, [num_envs, time]))
    terminated, truncated = torch.zeros(2, num_envs, time, 1, dtype=torch.bool)
    terminated[0, 2] = terminated[1, 5] = True
    truncated[0, 4] = truncated[1, 1] = True
    done = terminated | truncated
    following = torch.where(done[..., None, None], frames(num_envs, time), shown[:, 1:])
    data["next"] = TensorDict(
        {
            "observation": following,
            "reward": torch.randn(num_envs, time, 1),
            "terminated": terminated,
            "truncated": truncated,
            "done": done,
        },
        [num_envs, time],
    )
    assert not done[[0, 2], -1].any()  # Two episodes go on after the batch.
    return data


@pytest.fixture
def agent():
    torch.manual_seed(0)
    agent = PixelActorCritic(4)
    with torch.no_grad():
        agent.critic.weight.mul_(20)  # Values that a wrong bootstrap shows.
        agent.critic.bias.fill_(2.0)
    return agent


def ordinary(agent, data, *, bootstrap):
    """Advantages by a value network that looks at both observations of each transition."""
    data = data.exclude("state_value", ("next", "state_value"))
    if bootstrap:
        data["next", "terminated"] = torch.zeros_like(data["next", "terminated"])

    def value(observation):
        return agent.critic(agent.hidden(observation))

    network = TensorDictModule(value, ["observation"], ["state_value"])
    gae = GAE(gamma=GAMMA, lmbda=LMBDA, value_network=network, average_gae=False)
    with torch.no_grad():
        gae(data)
    return data


@pytest.mark.parametrize("termination", ["ends", "bootstrap"])
def test_advantages_are_those_of_an_ordinary_value_network(agent, termination):
    data = collected(agent)
    expected = {x: ordinary(agent, data, bootstrap=x == "bootstrap") for x in ("ends", "bootstrap")}
    cfg = config(gamma=GAMMA, lmbda=LMBDA, minibatch=18)
    PPO(agent, cfg, steps=1, termination=termination).update(data)
    same = expected[termination]
    torch.testing.assert_close(data["value_target"], same["value_target"], rtol=1e-4, atol=1e-4)
    advantage = same["advantage"]
    standardised = (advantage - advantage.mean()) / advantage.std()
    torch.testing.assert_close(data["advantage"], standardised, rtol=1e-3, atol=1e-4)
    other = expected["bootstrap" if termination == "ends" else "ends"]
    assert not torch.allclose(data["value_target"], other["value_target"], atol=0.1)


def test_the_trunk_sees_only_what_it_has_not_seen(agent):
    data = collected(agent)
    sizes = []
    agent.actor.trunk.register_forward_hook(lambda _, inputs, out: sizes.append(len(out)))
    agent.prepare(data, data["next", "observation"])
    # Two ends and a running episode, two ends of which one is the batch's, a running episode.
    assert sizes == [3 + 2 + 1]


def test_what_follows_an_unnoticed_reset_is_given_apart(agent):
    data = collected(agent)
    following = data["next", "observation"].clone()
    following[0, 2] = frames()
    agent.prepare(data, following)
    with torch.no_grad():
        expected = agent.critic(agent.hidden(following[0, 2]))
    torch.testing.assert_close(data["next", "state_value"][0, 2], expected)


@pytest.mark.parametrize("clip_value", [True, False])
def test_the_value_loss_is_clipped_where_asked(agent, clip_value):
    data = collected(agent)
    old = data["state_value"].clone()
    with torch.no_grad():
        agent.critic.bias.add_(0.7)  # As if earlier minibatches had moved the value.
        value = agent.critic(agent.hidden(data["observation"]))
    cfg = config(clip_value=clip_value, clip=0.1, minibatch=18)
    losses = PPO(agent, cfg, steps=1).update(data)
    target = data["value_target"]
    squared = (value - target) ** 2
    clipped = torch.maximum(squared, (old + 0.1 - target) ** 2)
    assert not torch.isclose(clipped.mean(), squared.mean(), rtol=0.01)
    expected = 0.5 * (clipped if clip_value else squared).mean()
    assert losses["loss_critic"] == pytest.approx(expected.item(), rel=1e-4)


# Whole trainings

BATCH = 2 * 16


def learned_reward(env):
    """GIRIL's whole way from transition to scaled reward, on an untrained model."""
    reward = GenerativeReward.for_pixels(env.action_spec, seed=0)
    return Compose(IntrinsicReward(reward), BatchMeanReward(), ReturnScaling(0.99))


def train(folder, *, steps=4 * BATCH, env=AtariEnv, relabel=learned_reward, seed=0, **kwargs):
    """Trains in ``folder`` with objects of its own; all that the last checkpoint holds."""
    pytest.importorskip("ale_py")
    env = env("breakout", 2, **kwargs)
    agent, cfg = make_agent(env, config(), seed=0), config()
    with Run.open(folder, {}, recipe="x") as run:
        train_policy(env, PPO(agent, cfg, steps=steps), relabel(env), seed=seed, run=run)
        state = run.load("ppo")
    env.close()
    state.pop("seconds")
    for name, value in agent.state_dict().items():
        assert torch.equal(value, state["algorithm"]["agent"][name])
    return state


def same(one, other):
    """Whether nested states are equal, bit for bit."""
    (a, shape), (b, other_shape) = tree_flatten(one), tree_flatten(other)
    return shape == other_shape and all(
        torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y
        for x, y in zip(a, b, strict=True)
    )


def policy(state):
    return state["algorithm"]["agent"]


def test_a_run_stopped_again_and_again_ends_bit_for_bit_as_an_undisturbed_one(tmp_path):
    expected = train(tmp_path / "whole")
    for number, how in ((1, Interrupted), (3, Killed)):
        with stopped(how, number * BATCH):
            train(tmp_path / "run")
        torch.manual_seed(1234 + number)  # As in a new process.
    assert same(train(tmp_path / "run"), expected)
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
    assert not same(policy(train(tmp_path / "seed", seed=1)), policy(expected))


class Garbled(AtariEnv):
    """Breakout with another reward."""

    def _step(self, tensordict):
        out = super()._step(tensordict)
        noise = torch.arange(2.0).unsqueeze(-1) + float(out["observation"].float().std())
        return out.set("reward", 1e3 * noise)


def test_the_learner_cannot_see_the_true_reward(tmp_path):
    def trained(relabel):
        return [
            policy(
                train(
                    tmp_path / f"{env.__name__}{relabel.__name__}",
                    env=env,
                    relabel=relabel,
                    steps=BATCH,
                )
            )
            for env in (AtariEnv, Garbled)
        ]

    assert same(*trained(learned_reward))
    assert not same(*trained(lambda env: Compose()))  # The garbage was there.


def test_the_log_tells_whole_games(tmp_path):
    """By hand: 160 frames are 40 steps, less 2 for a game's opening and 3 for each later life's."""
    train(tmp_path, steps=5 * BATCH, frame_cap=160)
    ended = [row for row in rows(tmp_path) if row["train/episodes"]]
    assert [(row["step"], row["train/episodes"]) for row in ended] == [
        (3 * BATCH, 2),
        (5 * BATCH, 2),
    ]
    # The mean of two games, each of one to three lives.
    assert all(row["train/length_mean"] in (32, 33.5, 35, 36.5, 38) for row in ended)
