"""The discriminator beside an off-policy learner: whose pairs, how many steps, and a killed run."""

import gymnasium
import pytest
import torch
from nested_state import assert_equal
from random_pairs import pairs
from short_runs import Garbage, Killed, rows, stopped
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import Compose

from giril_rl.config.schema import SACConfig
from giril_rl.envs import GymVectorEnv
from giril_rl.policies.making import make_sac_agent
from giril_rl.rewards import DiscriminatorConfig, DiscriminatorLoss, DiscriminatorReward
from giril_rl.rewards.airl import AIRLLoss, AIRLReward
from giril_rl.runs.checkpoint import load_state, save_state
from giril_rl.runs.run import Run
from giril_rl.training.loop import train_policy
from giril_rl.training.replay import Replay
from giril_rl.training.reward_trainers import (
    AdversarialTrainer,
    absorbing_value,
    terminal_rate,
)
from giril_rl.training.sac import SAC
from giril_rl.transforms import IntrinsicReward

BOX = Bounded(-1.0, 1.0, shape=(1,))


def with_ends(batch, every=5):
    """The same batch, each ``every``-th transition of which failed."""
    count = torch.arange(batch.numel()).reshape(*batch.shape, 1)
    batch["next"] = {"terminated": count % every == every - 1, "observation": batch["observation"]}
    return batch


def trainer_of(source, *, updates=3, every=10, batch=16, **kwargs):
    """GAIL's, with an expert of 20 pairs."""
    reward = DiscriminatorReward.for_vectors(3, BOX, hidden=[16], normalise="running", seed=1)
    cfg = DiscriminatorConfig(updates=updates, every=every, batch=batch)
    expert = pairs(20, seed=9)
    return AdversarialTrainer(
        DiscriminatorLoss(reward), expert, cfg, seed=0, source=source, **kwargs
    )


def seen_by(trainer, monkeypatch):
    """The inputs of all gradient steps from now on."""
    seen, step = [], trainer.gradients.step
    monkeypatch.setattr(trainer.gradients, "step", lambda x: seen.append(list(x)) or step(x))
    return seen


def test_gradient_steps_follow_environment_steps(monkeypatch):
    trainer = trainer_of(lambda count: None, updates=3, every=10)
    seen = seen_by(trainer, monkeypatch)
    counts = []
    for size in (4, 4, 4, 64, 1, 3):  # 3 steps for each 10: after 4, 8, 12, 76, 77 and 80.
        metrics = trainer.update(pairs(1, size))
        counts.append(len(seen))
        assert ("discriminator/loss_expert" in metrics) == (len(seen) > sum(counts[-2:-1]))
    assert counts == [1, 2, 3, 22, 23, 24]


def test_pairs_come_from_the_replay_once_it_has_any(monkeypatch):
    stored, asked = [], []

    def source(count):
        asked.append(count)
        if not stored:
            return None
        return stored[0][torch.randint(len(stored[0]), (count,))]

    trainer = trainer_of(source, updates=1, every=5, batch=16)
    seen = seen_by(trainer, monkeypatch)
    first, second = pairs(2, 5, seed=1), pairs(2, 5, seed=2)
    trainer.update(first)
    stored.append(first.reshape(-1))
    trainer.update(second)
    assert asked == [32, 32]  # Two steps each, drawn at once.
    known = first.reshape(-1)["observation"].tolist()
    assert [len(inputs[2]) for inputs in seen] == [10, 10, 16, 16]
    assert all(row in known for inputs in seen for row in inputs[2].tolist())


def test_the_experts_failures_count_by_the_whole_demonstration(monkeypatch):
    demonstration = with_ends(pairs(20, seed=9))
    assert terminal_rate(demonstration) == pytest.approx(0.2)
    kept = demonstration[::5]  # None of the four failures.
    assert not kept["next", "terminated"].any()
    reward = DiscriminatorReward.for_vectors(3, BOX, hidden=[8], normalise="raw", absorbing=True)
    trainer = AdversarialTrainer(
        DiscriminatorLoss(reward),
        kept,
        DiscriminatorConfig(updates=1, batch=8),
        seed=0,
        terminal_rate=terminal_rate(demonstration),
    )
    seen = seen_by(trainer, monkeypatch)
    trainer.update(with_ends(pairs(2, 5), every=2))
    assert seen[0][2].flatten().tolist() == pytest.approx([0.2] * 4)
    assert seen[0][5].dtype == torch.bool and len(seen[0][5]) == 8


def test_log_probabilities_are_the_present_policys(monkeypatch):
    scale = [1.0]

    def log_prob(observation, action):
        return scale[0] * observation.sum(-1)

    reward = AIRLReward.for_vectors(3, BOX, hidden=[8], normalise="raw")
    trainer = AdversarialTrainer(
        AIRLLoss(reward),
        with_ends(pairs(20, seed=9)),
        DiscriminatorConfig(updates=1, batch=8),
        seed=0,
        log_prob=log_prob,
    )
    seen = seen_by(trainer, monkeypatch)
    for scale[0] in (1.0, 2.0):
        trainer.update(with_ends(pairs(2, 10)))
        expert, policy = seen[-1][:5], seen[-1][5:]
        for side in (expert, policy):
            torch.testing.assert_close(side[4], scale[0] * side[0].sum(-1))


def test_it_goes_on_from_its_state_bit_for_bit(tmp_path):
    def fresh():
        replay = Replay(["observation", "action"], size=100)
        replay.extend(pairs(50, seed=3))
        return trainer_of(replay.own, updates=1, every=7)

    whole, first, second = fresh(), fresh(), fresh()
    batches = [pairs(2, 5, seed=k) for k in range(4)]
    for batch in batches[:2]:
        whole.update(batch)
        first.update(batch)
    save_state(tmp_path / "state.safetensors", first.state_dict())
    second.load_state_dict(load_state(tmp_path / "state.safetensors"))
    for batch in batches[2:]:
        assert whole.update(batch) == second.update(batch)
    assert_equal(second.state_dict(), whole.state_dict())


# In SAC's loop

CFG = SACConfig(
    num_envs=2,
    rollout=8,
    batch=16,
    hidden=[8],
    random_steps=32,
    buffer_size=200,
    checkpoint_every=32,
    log_every=16,
)
STEPS = 128


def train(folder, garbage=None):
    """GAIL with absorbing states beside SAC, the replay seeded with a demonstration."""

    def make_fn():
        return Garbage(gymnasium.make("Pendulum-v1").unwrapped, garbage)

    env = GymVectorEnv(make_fn, 2, max_episode_steps=20)
    expert = with_ends(pairs(20, seed=9))
    spec = env.action_spec
    reward = DiscriminatorReward.for_vectors(
        3, spec, hidden=[8], normalise="running", absorbing=True, seed=1
    )
    transform = Compose(IntrinsicReward(reward), *absorbing_value(reward, CFG.gamma))
    with Run.open(folder, {}, recipe="x") as run:
        sac = SAC(
            make_sac_agent(env, CFG, seed=0),
            CFG,
            steps=STEPS,
            folder=folder / "replay",
            demonstration=expert,
            relabel=transform,
        )
        trainer = AdversarialTrainer(
            DiscriminatorLoss(reward, penalty=1.0),
            expert,
            DiscriminatorConfig(updates=1, every=4, batch=12),
            seed=0,
            source=sac.own,
            terminal_rate=terminal_rate(expert),
        )
        train_policy(env, sac, transform, seed=0, run=run, reward_trainer=trainer)
        state = run.load("sac")
    env.close()
    state.pop("seconds")
    return state


def test_a_run_stopped_again_and_again_ends_bit_for_bit_as_an_undisturbed_one(tmp_path):
    expected = train(tmp_path / "whole")
    for number in (48, 64, 112):
        with stopped(Killed, number):
            train(tmp_path / "run")
        torch.manual_seed(number)
    assert_equal(train(tmp_path / "run"), expected)
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
    assert "discriminator/loss_expert" in rows(tmp_path / "run")[-1]


def test_neither_policy_nor_discriminator_sees_the_true_reward(tmp_path):
    expected = train(tmp_path / "true")
    found = train(tmp_path / "noise", garbage="noise")
    for name in ("algorithm", "transform", "reward_trainer", "rng"):
        assert_equal(found[name], expected[name])


def test_own_transitions_are_not_the_demonstrations():
    known = TensorDict({"observation": torch.full((500, 1), 7.0)}, [500])
    replay = Replay(["observation"], size=100, demonstration=known)
    replay.extend(TensorDict({"observation": torch.zeros(10, 1)}, [10]))
    assert replay.sample(100)["observation"].any()
    assert not replay.own(100)["observation"].any()
