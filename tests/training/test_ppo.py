from functools import partial

import gymnasium
import nested_state
import numpy as np
import pytest
import torch
from short_runs import Garbage, Killed, rows, stopped
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.envs import Compose

from giril_rl.config.schema import PPOConfig, TaskConfig
from giril_rl.envs import GymVectorEnv, make_env
from giril_rl.errors import UserError
from giril_rl.policies.actor_critic import NORMALISED, ActorCritic
from giril_rl.policies.making import make_agent
from giril_rl.policies.pixel_actor_critic import PixelActorCritic
from giril_rl.rewards import GenerativeReward
from giril_rl.runs.checkpoint import load_state
from giril_rl.runs.interrupt import Interrupted
from giril_rl.runs.run import Run
from giril_rl.training.loop import train_policy
from giril_rl.training.ppo import PPO
from giril_rl.transforms import BatchMeanReward, IntrinsicReward, ReturnScaling

BULLET = "InvertedPendulumBulletEnv-v0"
SMALL = {"num_envs": 4, "rollout": 32, "minibatch": 64, "epochs": 2, "hidden": [16, 16]}
BATCH = 4 * 32

assert_equal = partial(nested_state.assert_equal, equal_nan=True)


def config(**kwargs):
    return PPOConfig(**{**SMALL, "checkpoint_every": 2 * BATCH, **kwargs})


def make(env_id, num_envs=4, seed=0):
    return make_env(TaskConfig(name="test", env_id=env_id), num_envs, seed)


def learned_reward(env, *, beta=1.0, batch_mean=True, seed=0):
    """GIRIL's whole way from transition to scaled reward, on an untrained model."""
    size = env.observation_spec["observation"].shape[-1]
    reward = GenerativeReward.for_vectors(
        size, env.action_spec, hidden=[16], beta=beta, normalise="raw", seed=seed
    )
    mean = [BatchMeanReward()] if batch_mean else []
    return Compose(IntrinsicReward(reward), *mean, ReturnScaling(0.99))


# Advantages


def collected(agent, num_envs=3, time=40):
    """A batch whose next observations have nothing to do with the following observations."""
    data = TensorDict({"observation": 3 * torch.randn(num_envs, time, 4) + 1}, [num_envs, time])
    data = agent.acting()(data)
    terminated = torch.rand(num_envs, time, 1) < 0.2
    truncated = torch.rand(num_envs, time, 1) < 0.2
    data["next"] = TensorDict(
        {
            "observation": 3 * torch.randn(num_envs, time, 4) - 1,
            "reward": torch.randn(num_envs, time, 1),
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        },
        [num_envs, time],
    )
    only_truncated = truncated & ~terminated
    assert terminated.any() and only_truncated.any() and (terminated & truncated).any()
    assert not data["next", "done"][:, -1].all()
    return data


def value_of(agent, observation):
    with torch.no_grad():
        return agent.critic(agent.normaliser(observation)).squeeze(-1).double().numpy()


def gae_by_hand(agent, data, gamma, lmbda):
    value = value_of(agent, data["observation"])
    following = value_of(agent, data["next", "observation"])
    names = ("reward", "terminated", "done")
    reward, terminated, done = (data["next", n][..., 0].double().numpy() for n in names)
    advantage = np.zeros_like(value)
    carry = np.zeros(len(value))
    for t in reversed(range(value.shape[1])):
        # Bootstraps unless the episode failed; looks further unless it ended.
        delta = reward[:, t] + gamma * following[:, t] * (1 - terminated[:, t]) - value[:, t]
        carry = delta + gamma * lmbda * (1 - done[:, t]) * carry
        advantage[:, t] = carry
    return advantage, advantage + value


@pytest.mark.parametrize(("gamma", "lmbda"), [(0.99, 0.95), (0.5, 1.0), (0.9, 0.0), (1.0, 1.0)])
def test_advantages_are_those_of_a_loop(gamma, lmbda):
    torch.manual_seed(1)
    env = make("CartPole-v1", 3)
    agent = ActorCritic(4, env.action_spec, hidden=(16,))
    with torch.no_grad():
        agent.critic[-1].bias.fill_(2.0)  # A value that a wrong bootstrap shows.
    agent.update_normaliser(2 * torch.randn(200, 4) + 1)
    data = collected(agent)
    advantage, target = gae_by_hand(agent, data, gamma, lmbda)
    cfg = PPOConfig(gamma=gamma, lmbda=lmbda, minibatch=40, epochs=1)
    PPO(agent, cfg, steps=1).update(data)
    # Standardised over the whole batch, whatever the minibatches.
    standardised = (advantage - advantage.mean()) / advantage.std(ddof=1)
    found = data["advantage"][..., 0].numpy()
    np.testing.assert_allclose(found, standardised, atol=2e-5, rtol=1e-4)
    np.testing.assert_allclose(data["value_target"][..., 0].numpy(), target, atol=2e-5, rtol=1e-4)


def test_a_truncated_episode_bootstraps_from_its_true_terminal_observation(step_counter):
    """By hand: values are the step number, rewards and lambda 0: the target is gamma V(s')."""

    def targets(length, limit):
        env = GymVectorEnv(lambda: step_counter(length=length), 1, max_episode_steps=limit)
        agent = ActorCritic(3, env.action_spec, hidden=(), normalise=False)
        with torch.no_grad():
            agent.critic[-1].weight.copy_(torch.tensor([[0.0, 1.0, 0.0]]))
        data = env.rollout(7, agent.acting(), break_when_any_done=False).contiguous()
        data["next", "reward"].zero_()
        cfg = PPOConfig(gamma=0.5, lmbda=0.0, minibatch=7, epochs=1)
        PPO(agent, cfg, steps=1).update(data)
        return data["value_target"].flatten().tolist()

    # The third step ends in step 3, whose value counts after a time limit and not after a failure.
    assert targets(length=99, limit=3) == [0.5, 1.0, 1.5, 0.5, 1.0, 1.5, 0.5]
    assert targets(length=3, limit=99) == [0.5, 1.0, 0.0, 0.5, 1.0, 0.0, 0.5]
    assert targets(length=3, limit=3) == targets(length=3, limit=99)


# One update


def learner_and_batch(**kwargs):
    torch.manual_seed(0)
    agent = ActorCritic(4, make("CartPole-v1").action_spec, hidden=(16,))
    cfg = config(minibatch=40, **kwargs)
    return PPO(agent, cfg, steps=1000), collected(agent)


def test_the_first_minibatch_has_ratio_one():
    learner, data = learner_and_batch(epochs=1)
    learner.cfg.minibatch = 120
    losses = learner.update(data)
    assert losses["clip_fraction"] == 0.0
    assert abs(losses["kl_approx"]) < 1e-6
    # With ratio 1 the objective is minus the mean normalised advantage, which is 0.
    assert abs(losses["loss_objective"]) < 1e-5


class InUnits(gymnasium.ActionWrapper):
    """The same environment with actions in [-2048, 2048], a power of two, so that bits stay."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = gymnasium.spaces.Box(-2048.0, 2048.0, (1,))

    def action(self, action):
        return action / 2048


@pytest.mark.parametrize("normalise", [True, False])
def test_units_of_the_action_do_not_matter(step_counter, normalise, tmp_path):
    def trained(wrapper, name):
        env = GymVectorEnv(lambda: wrapper(step_counter()), 4)
        agent = make_agent(env, config(normalise_observations=normalise), seed=0)
        with Run.open(tmp_path / name, {}, recipe="x") as run:
            train_policy(env, PPO(agent, config(), steps=3 * BATCH), Compose(), seed=0, run=run)
        return agent.state_dict()

    assert_equal(dict(trained(InUnits, "b")), dict(trained(lambda env: env, "a")))


@pytest.mark.parametrize("pixels", [False, True])
def test_one_hot_actions_are_learned_as_integers_are(pixels):
    """The same weights from the same data, for all that the encoding differs."""
    learned = []
    for spec in (Categorical(3), OneHot(3)):
        torch.manual_seed(0)
        agent = PixelActorCritic(spec) if pixels else ActorCritic(3, spec, hidden=(8,))
        shape = (4, 84, 84) if pixels else (3,)
        observed = torch.randint(256, (2, 3, *shape), dtype=torch.uint8)
        data = TensorDict({"observation": observed if pixels else observed / 99.0}, [2, 3])
        torch.manual_seed(1)
        data = agent.acting()(data)
        assert data["action"].shape == (2, 3, *spec.shape)
        false = torch.zeros(2, 3, 1, dtype=torch.bool)
        data["next"] = {
            "observation": data["observation"].roll(-1, 1),
            "reward": torch.randn(2, 3, 1),
            **dict.fromkeys(("done", "terminated"), false),
        }
        cfg = PPOConfig(minibatch=3, epochs=2, lr=0.01)
        PPO(agent, cfg, steps=1000).update(data)
        learned.append(dict(agent.state_dict()))
    assert_equal(*learned)


def test_an_agent_made_for_other_actions_is_refused(step_counter, tmp_path):
    env = GymVectorEnv(lambda: InUnits(step_counter()), 4)
    agent = ActorCritic(3, Bounded(-1, 1, shape=(1,)))
    with (
        Run.open(tmp_path, {}, recipe="x") as run,
        pytest.raises(UserError, match=r"made for actions .*-1.* environment has .*-2048"),
    ):
        train_policy(env, PPO(agent, config(), steps=BATCH), Compose(), seed=0, run=run)


def test_the_normaliser_learns_after_the_update_has_used_it():
    learner, data = learner_and_batch()
    learner.update(data)
    twin, same = learner_and_batch()
    normalised = twin.agent.normaliser(same["observation"])
    assert torch.equal(data[NORMALISED], normalised)
    statistics = learner.agent.normaliser
    flat = data["observation"].flatten(0, 1)
    torch.testing.assert_close(statistics.mean.float(), flat.mean(0), atol=1e-4, rtol=1e-4)
    assert statistics.count.item() == pytest.approx(120, abs=1)


def at(learner, taken):
    """The learner as it is after ``taken`` environment steps."""
    learner.load_state_dict({**learner.state_dict(), "steps": taken})
    return learner


def test_step_size_decreases_only_where_asked():
    for anneal, expected in ((True, [3e-4, 1.5e-4, 0.375e-4]), (False, [3e-4] * 3)):
        learner, data = learner_and_batch(anneal_lr=anneal)
        found = []
        for taken in (0, 512, 896):  # Of 1,024.
            at(learner, taken).update(data.clone())
            found.append(learner.optimizer.param_groups[0]["lr"])
        assert found == pytest.approx(expected)


def test_a_step_size_of_almost_nothing_changes_almost_nothing():
    def change(taken):
        learner, data = learner_and_batch(anneal_lr=True)
        before = learner.agent.actor[0].weight.clone()
        at(learner, taken).update(data)
        return (learner.agent.actor[0].weight - before).abs().max()

    assert change(0) > 500 * change(1023)


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_entropy_bonus_keeps_the_policy_random(env_id, tmp_path):
    def entropy(coefficient):
        env = make(env_id)
        cfg = config(entropy_coef=coefficient, lr=0.01)
        agent = make_agent(env, cfg, seed=0)
        with Run.open(tmp_path / str(coefficient), {}, recipe="x") as run:
            train_policy(env, PPO(agent, cfg, steps=4 * BATCH), Compose(), seed=0, run=run)
        data = env.rollout(20, agent.acting(), break_when_any_done=False)
        return agent.actor_for_loss().get_dist(data).entropy().mean()

    assert entropy(1.0) > entropy(0.0)


# Whole trainings


def train(
    folder, env_id="CartPole-v1", *, steps=4 * BATCH, relabel=learned_reward, seed=0, **kwargs
):
    """Trains in ``folder`` with objects of its own; what is left and the checkpoint."""
    cfg = config(**kwargs)
    env = make(env_id)
    agent, transform = make_agent(env, cfg, seed=0), relabel(env)
    with Run.open(folder, {}, recipe="x") as run:
        trained = train_policy(env, PPO(agent, cfg, steps=steps), transform, seed=seed, run=run)
        state = run.load("ppo")
    env.close()
    state.pop("seconds")
    assert_equal(dict(agent.state_dict()), state["algorithm"]["agent"])
    return trained, state


CASES = {
    "cartpole": {"env_id": "CartPole-v1"},
    "bullet, noisy reward": {
        "env_id": BULLET,
        "relabel": partial(learned_reward, beta=0.6, batch_mean=False),
    },
    "cartpole, step size, noisy reward": {
        "env_id": "CartPole-v1",
        "relabel": partial(learned_reward, beta=0.6),
        "anneal_lr": True,
    },
    "true reward, no normalisation": {
        "env_id": "CartPole-v1",
        "relabel": lambda env: Compose(ReturnScaling(0.99, reset="done")),
        "normalise_observations": False,
    },
}


QUICK = ("cartpole", "bullet, noisy reward")


@pytest.mark.parametrize(
    "case",
    [c if c in QUICK else pytest.param(c, marks=pytest.mark.slow) for c in (*CASES, "compiled")],
)
def test_a_run_stopped_again_and_again_ends_bit_for_bit_as_an_undisturbed_one(case, tmp_path):
    settings = CASES.get(case, {"compile": True})
    _, expected = train(tmp_path / "whole", **settings)
    # Before the first checkpoint; at an extra checkpoint; between two checkpoints; at the end.
    stops = (1, Killed), (1, Interrupted), (3, Killed), (3, Interrupted), (4, Interrupted)
    for number, how in stops:
        with stopped(how, number * BATCH):
            train(tmp_path / "run", **settings)
        if how is Interrupted:
            saved = load_state(tmp_path / "run" / "ppo.safetensors")
            assert saved["steps"] == number * BATCH
        # As in a new process: other objects, other random numbers.
        torch.manual_seed(1234 + number)
    trained, state = train(tmp_path / "run", **settings)
    assert trained.steps == 4 * BATCH
    assert_equal(state, expected)
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
    assert len(rows(tmp_path / "run")) == 4


def test_another_seed_or_setting_makes_another_run(tmp_path):
    """Or equality above would mean nothing."""
    found = []
    for name, change in (("first", {}), ("lr", {"lr": 2e-4}), ("seed", {"seed": 1})):
        state = train(tmp_path / name, **change)[1]
        found.append(state["algorithm"]["agent"]["actor.0.weight"])
    assert not torch.equal(found[0], found[1]) and not torch.equal(found[0], found[2])


def test_a_finished_training_is_only_loaded(tmp_path, monkeypatch):
    trained, expected = train(tmp_path)
    before = (tmp_path / "ppo.safetensors").stat().st_mtime_ns
    monkeypatch.setattr(GymVectorEnv, "_step", None)
    again, state = train(tmp_path)
    assert again.steps == trained.steps
    assert_equal(state, expected)
    assert (tmp_path / "ppo.safetensors").stat().st_mtime_ns == before


def test_the_tracker_and_metrics_tell_true_returns(tmp_path):
    train(tmp_path)
    found = rows(tmp_path)
    assert [row["step"] for row in found] == [BATCH * k for k in (1, 2, 3, 4)]
    for row in found:
        assert row["phase"] == "ppo"
        # A reward of 1 for each step: return and length are one number, and whole.
        assert row["train/return_mean"] == row["train/length_mean"] > 5
        assert 0 < row["train/episodes"] <= BATCH / 8
        assert row["ppo/reward_mean"] != 1.0
    assert np.isfinite([value for row in found for value in list(row.values())[1:]]).all()


def trained_on(kind, folder, relabel, env_id):
    cfg = config()

    def make_fn():
        return Garbage(gymnasium.make(env_id).unwrapped, kind)

    env = GymVectorEnv(make_fn, 4, max_episode_steps=20)
    agent, transform = make_agent(env, cfg, seed=0), relabel(env)
    with Run.open(folder, {}, recipe="x") as run:
        train_policy(env, PPO(agent, cfg, steps=3 * BATCH), transform, seed=0, run=run)
    return dict(agent.state_dict()), dict(transform.state_dict())


@pytest.mark.parametrize(
    "env_id", [pytest.param("CartPole-v1", marks=pytest.mark.slow), "Pendulum-v1"]
)
def test_the_learner_cannot_see_the_true_reward(env_id, tmp_path):
    expected = trained_on("true", tmp_path / "true", learned_reward, env_id)
    for kind in ("noise", "nan"):
        found = trained_on(kind, tmp_path / kind, learned_reward, env_id)
        for one, other in zip(found, expected, strict=True):
            assert_equal(one, other)
    # The garbage was there: the log tells it, and a learner of the true reward does learn from it.
    returns = {k: rows(tmp_path / k)[-1]["train/return_mean"] for k in ("true", "noise", "nan")}
    assert len(set(returns.values())) == 3 and returns["nan"] is None
    naive = [
        trained_on(kind, tmp_path / f"naive {kind}", lambda env: Compose(), env_id)[0]
        for kind in ("true", "noise")
    ]
    assert not torch.equal(naive[0]["actor.0.weight"], naive[1]["actor.0.weight"])


def test_cartpole_is_learned(tmp_path):
    """About 22 steps at the start; a constant reward per step makes standing worth the while."""
    cfg = PPOConfig(
        num_envs=8, rollout=128, minibatch=128, epochs=10, lr=1e-3, clip=0.2, hidden=[32, 32]
    )
    env = make("CartPole-v1", 8)
    agent = make_agent(env, cfg, seed=0)
    with Run.open(tmp_path, {}, recipe="x") as run:
        train_policy(env, PPO(agent, cfg, steps=15 * 1024), Compose(), seed=0, run=run)
    returns = [row["train/return_mean"] for row in rows(tmp_path)]
    assert returns[0] < 35
    assert np.mean(returns[-3:]) > 90


def test_training_stops_at_a_score(tmp_path, step_counter):
    """Episodes of 5 steps, 12 or 13 of them in a batch: 20 are there in the second batch."""

    def make_fn():
        return gymnasium.wrappers.TransformReward(step_counter(length=5), lambda reward: 1.0)

    def stopped_after(folder, stop_at):
        env = GymVectorEnv(make_fn, 2)
        cfg = config(num_envs=2, rollout=32, checkpoint_every=10_000)
        agent = make_agent(env, cfg, seed=0)
        with Run.open(tmp_path / folder, {}, recipe="x") as run:
            steps = train_policy(
                env, PPO(agent, cfg, steps=4 * 64), Compose(), seed=0, run=run, stop_at=stop_at
            ).steps
            assert run.load("ppo")["steps"] == steps
            return steps, dict(agent.state_dict())

    assert stopped_after("reached", 5.0)[0] == 128
    steps, weights = stopped_after("reached", 5.0)  # The same again, which has nothing to do.
    assert steps == 128
    assert_equal(weights, stopped_after("elsewhere", 5.0)[1])
    assert stopped_after("not reached", 5.01)[0] == 256
    assert stopped_after("never", None)[0] == 256


def test_the_global_seed_decides_nothing(tmp_path):
    states = []
    for name in ("one", "two"):
        torch.manual_seed(hash(name) % 1000)
        states.append(train(tmp_path / name)[1])
    assert_equal(*states)


def test_relabel_may_be_any_module(tmp_path):
    class Constant(nn.Module):
        def forward(self, batch):
            return batch.set(("next", "reward"), torch.ones_like(batch["next", "reward"]))

    trained, _ = train(tmp_path, relabel=lambda env: Constant(), steps=BATCH)
    assert trained.steps == BATCH
