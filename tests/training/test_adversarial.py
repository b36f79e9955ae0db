"""The discriminator beside the policy: by itself, and in PPO's loop through ``learn_reward``."""

import gymnasium
import pytest
import torch
from nested_state import assert_equal
from random_pairs import pairs
from short_runs import Garbage, Killed, rows, stopped
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical
from torchrl.envs import Compose

from giril_rl.config.schema import PPOConfig
from giril_rl.envs import GymVectorEnv
from giril_rl.policies.making import make_agent
from giril_rl.rewards import (
    AdversarialConfig,
    BottleneckLoss,
    BottleneckReward,
    DiscriminatorLoss,
    DiscriminatorReward,
)
from giril_rl.runs.checkpoint import load_state, save_state
from giril_rl.runs.interrupt import Interrupted
from giril_rl.runs.run import Run
from giril_rl.training.loop import train_policy
from giril_rl.training.ppo import PPO
from giril_rl.training.reward_trainers import AdversarialTrainer
from giril_rl.transforms import IntrinsicReward, ReturnScaling

SPECS = {"box": Bounded(-1.0, 1.0, shape=(4, 1)), "discrete": Categorical(2, shape=(4,))}
METHODS = ("gail", "vail")


def make(method="gail", *, spec=SPECS["box"], expert=None, seed=0, dim=3, **kwargs):
    """A learner and its reward."""
    cfg = AdversarialConfig(**{"updates": 3, "batch": 32, "lr": 1e-2, "penalty": 0.0, **kwargs})
    cls = {"gail": DiscriminatorReward, "vail": BottleneckReward}[method]
    reward = cls.for_vectors(dim, spec, hidden=[16], normalise="running", seed=1)
    if method == "gail":
        loss = DiscriminatorLoss(reward, penalty=cfg.penalty)
    else:
        loss = BottleneckLoss(reward, penalty=cfg.penalty, beta_step=0.1, beta=0.5)
    expert = pairs(20, seed=9) if expert is None else expert
    return AdversarialTrainer(loss, expert, cfg, seed=seed), reward


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", SPECS)
def test_it_learns_to_pay_for_the_experts_pairs(method, kind):
    expert = pairs(50, kind=kind, seed=1)
    learner, reward = make(method, spec=SPECS[kind], expert=expert, updates=20)
    logs = [learner.update(pairs(4, 50, kind=kind, shift=2.0, seed=k)) for k in range(10)]
    first, last = logs[0], logs[-1]
    for which in ("expert", "policy"):
        assert last[f"discriminator/loss_{which}"] < first[f"discriminator/loss_{which}"]
        assert last[f"discriminator/accuracy_{which}"] > 0.75
    paid = [
        reward(data)["next", "intrinsic_reward"].mean()
        for data in (pairs(200, kind=kind, seed=5), pairs(200, kind=kind, shift=2.0, seed=6))
    ]
    assert paid[0] > 2 * paid[1]


def test_what_is_logged():
    names = ["accuracy_expert", "accuracy_policy", "loss_expert", "loss_policy"]
    found = make()[0].update(pairs(4, 50))
    assert sorted(found) == [f"discriminator/{name}" for name in names]
    found = make("vail", penalty=1.0)[0].update(pairs(4, 50))
    more = ["beta", "kl", "loss_bottleneck", "loss_penalty"]
    assert sorted(found) == sorted(f"discriminator/{name}" for name in [*names, *more])
    assert all(isinstance(value, float) for value in found.values())


def test_beta_follows_the_divergence():
    learner, _ = make("vail", updates=1)
    before = learner.loss.beta.item()
    found = learner.update(pairs(4, 50))
    kl, beta = found["discriminator/kl"], found["discriminator/beta"]
    assert beta == learner.loss.beta.item()
    assert beta == pytest.approx(max(0.0, before + 0.1 * (kl - 0.5)))


def test_the_first_step_is_adams_on_the_sets_as_they_are():
    """Both fit into one batch, so nothing is drawn: the step can be made by hand."""
    learner, reward = make(updates=1, batch=200)
    batch = pairs(4, 50)
    twin, same = make(updates=1, batch=200)
    same.observe(batch["observation"])
    both = {"expert": pairs(20, seed=9), "policy": batch.reshape(-1)}
    out = twin.loss(TensorDict({k: v.to_dict() for k, v in both.items()}))
    optimiser = torch.optim.Adam(twin.loss.parameters(), lr=1e-2)
    (out["loss_expert"] + out["loss_policy"]).backward()
    optimiser.step()
    found = learner.update(batch)
    assert found["discriminator/loss_expert"] == out["loss_expert"].item()
    for one, other in zip(reward.parameters(), same.parameters(), strict=True):
        torch.testing.assert_close(one, other, atol=1e-7, rtol=1e-6)


def test_minibatches_come_from_both_sets(monkeypatch):
    learner, _ = make(updates=4, batch=16, expert=pairs(20, seed=9))
    batch, seen = pairs(4, 50), []
    step = learner.gradients.step
    monkeypatch.setattr(learner.gradients, "step", lambda x: seen.append(x) or step(x))
    learner.update(batch)
    assert [[len(x) for x in inputs] for inputs in seen] == [[16] * 4] * 4
    for which, data in ((0, pairs(20, seed=9)), (2, batch.reshape(-1))):
        known = torch.cat((data["observation"], data["action"]), 1).tolist()
        drawn = [torch.cat(inputs[which : which + 2], 1).tolist() for inputs in seen]
        for lines in drawn:
            assert all(row in known for row in lines)
            assert len({tuple(row) for row in lines}) == 16
        assert drawn[0] != drawn[1]


def test_only_pairs_are_read_and_nothing_is_written():
    batch = pairs(4, 50)
    bare = make()[0].update(batch.clone())
    junk = torch.full((4, 50, 1), float("nan"))
    batch["next"] = {"reward": junk, "observation": torch.randn(4, 50, 3), "done": junk > 0}
    before = batch.clone()
    assert make()[0].update(batch) == bare
    assert set(batch.keys(True)) == set(before.keys(True))
    assert torch.equal(batch["observation"], before["observation"])


@pytest.mark.parametrize("method", METHODS)
def test_its_seed_and_nothing_else_decides(method):
    def trained(seed, other):
        torch.manual_seed(other)
        learner, _ = make(method, seed=seed, penalty=1.0)
        before = torch.get_rng_state()
        logs = [learner.update(pairs(4, 50, seed=k)) for k in range(3)]
        assert torch.equal(torch.get_rng_state(), before)
        return {"logs": logs, **learner.state_dict()}

    assert_equal(trained(3, 0), trained(3, 1))
    assert trained(3, 0)["logs"] != trained(4, 0)["logs"]


@pytest.mark.parametrize("method", METHODS)
def test_it_goes_on_from_its_state_bit_for_bit(method, tmp_path):
    whole, _ = make(method, penalty=1.0)
    first, _ = make(method, penalty=1.0)
    batches = [pairs(4, 50, seed=k, shift=0.1 * k) for k in range(4)]
    for batch in batches[:2]:
        whole.update(batch)
        first.update(batch)
    save_state(tmp_path / "state.safetensors", first.state_dict())
    second, _ = make(method, penalty=1.0, seed=77)
    second.update(pairs(4, 50, seed=55))
    second.load_state_dict(load_state(tmp_path / "state.safetensors"))
    for batch in batches[2:]:
        assert whole.update(batch) == second.update(batch)
    assert_equal(second.state_dict(), whole.state_dict())


# In PPO's loop

CFG = PPOConfig(
    num_envs=4, rollout=32, minibatch=64, epochs=2, hidden=[16, 16], checkpoint_every=256
)
BATCH = 4 * 32
ENVS = {"discrete": "CartPole-v1", "box": "Pendulum-v1"}


def train(folder, *, method="gail", kind="discrete", garbage=None, steps=4 * BATCH, learn=True):
    """Trains in ``folder`` with objects of its own; the checkpoint."""

    def make_fn():
        return Garbage(gymnasium.make(ENVS[kind]).unwrapped, garbage)

    env = GymVectorEnv(make_fn, 4, max_episode_steps=20)
    agent = make_agent(env, CFG, seed=0)
    dim = env.observation_spec["observation"].shape[-1]
    expert = pairs(20, kind=kind, dim=dim, seed=9)
    learner, reward = make(method, spec=env.action_spec, expert=expert, dim=dim, penalty=1.0)
    relabel = Compose(IntrinsicReward(reward), ReturnScaling(0.99))
    with Run.open(folder, {}, recipe="x") as run:
        train_policy(
            env,
            PPO(agent, CFG, steps=steps),
            relabel,
            seed=0,
            run=run,
            reward_trainer=learner if learn else None,
        )
        state = run.load("ppo")
    env.close()
    state.pop("seconds")
    return state


@pytest.mark.parametrize(
    ("method", "kind"), [pytest.param("gail", "discrete", marks=pytest.mark.slow), ("vail", "box")]
)
def test_a_run_stopped_again_and_again_ends_bit_for_bit_as_an_undisturbed_one(
    method, kind, tmp_path
):
    expected = train(tmp_path / "whole", method=method, kind=kind)
    for number, how in ((1, Killed), (1, Interrupted), (3, Killed), (3, Interrupted)):
        with stopped(how, number * BATCH):
            train(tmp_path / "run", method=method, kind=kind)
        torch.manual_seed(1234 + number)
    found = train(tmp_path / "run", method=method, kind=kind)
    assert_equal(found, expected)
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
    assert len(rows(tmp_path / "run")) == 4


@pytest.mark.parametrize("kind", [pytest.param("discrete", marks=pytest.mark.slow), "box"])
def test_neither_policy_nor_discriminator_sees_the_true_reward(kind, tmp_path):
    expected = train(tmp_path / "true", kind=kind)
    for garbage in ("noise", "nan"):
        found = train(tmp_path / garbage, kind=kind, garbage=garbage)
        # Not the tracker, which counts true returns for the log.
        for name in ("algorithm", "transform", "reward_trainer", "rng"):
            assert_equal(found[name], expected[name])
    returns = {rows(tmp_path / k)[-1]["train/return_mean"] for k in ("true", "noise", "nan")}
    assert len(returns) == 3


def test_the_discriminator_learns_before_the_batch_is_relabelled(tmp_path):
    with_it, without = (
        train(tmp_path / "a", steps=BATCH),
        train(tmp_path / "b", learn=False, steps=BATCH),
    )
    key = "transforms.0.module.network.0.weight"
    assert not torch.equal(with_it["transform"][key], without["transform"][key])
    paid = [rows(tmp_path / name)[0]["ppo/reward_mean"] for name in "ab"]
    assert paid[0] != paid[1]
    assert without["reward_trainer"] is None
    assert "discriminator/loss_expert" in rows(tmp_path / "a")[0]
    assert "discriminator/loss_expert" not in rows(tmp_path / "b")[0]
