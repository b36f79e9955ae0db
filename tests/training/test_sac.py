"""SAC: its loss by hand, what it may see, and runs that are stopped and continued."""

import copy
from dataclasses import replace

import gymnasium
import pytest
import torch
from nested_state import assert_equal
from short_runs import Garbage, Killed, rows, stopped
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot, Unbounded
from torchrl.envs import Compose

from giril_rl.config.schema import SACConfig, TaskConfig
from giril_rl.demos import Demonstration
from giril_rl.envs import GymVectorEnv
from giril_rl.errors import UserError
from giril_rl.policies import make_sac_agent
from giril_rl.policies.soft_actor_critic import SACAgent
from giril_rl.rewards import DiscriminatorReward
from giril_rl.runs.interrupt import Interrupted
from giril_rl.runs.run import Run
from giril_rl.training import SAC, evaluate, evaluate_both, train_policy
from giril_rl.training.algorithm import _steps
from giril_rl.transforms import IntrinsicReward
from giril_rl.transforms.scaling import ReturnScaling

CFG = SACConfig(
    num_envs=4,
    rollout=8,
    batch=16,
    hidden=[16, 16],
    random_steps=64,
    checkpoint_every=96,
    log_every=64,
    buffer_size=150,  # Less than the steps, so that the ring goes round.
)
BATCH, STEPS = 32, 384
CONSTANT = ("gamma", "alpha_init", "_target_entropy")
ENVS = {"discrete": "CartPole-v1", "box": "Pendulum-v1"}


def learned(env, seed=0):
    """A reward of random weights, in place of a trained one."""
    dim = env.observation_spec["observation"].shape[-1]
    return DiscriminatorReward.for_vectors(dim, env.action_spec, normalise="raw", seed=seed)


def train(folder, *, kind="box", garbage=None, moving=False, whole=False, known=False, **changes):
    """Trains in ``folder`` with objects of its own; the checkpoint."""

    def make_fn():
        return Garbage(gymnasium.make(ENVS[kind]).unwrapped, garbage)

    cfg = replace(CFG, **changes)
    env = GymVectorEnv(make_fn, 4, max_episode_steps=20)
    transform = Compose(IntrinsicReward(learned(env)))
    demonstration = None
    if known:
        torch.manual_seed(0)
        played = env.rollout(20, break_when_any_done=False).flatten(0, 1).exclude("collector")
        demonstration = transform(played)
        if cfg.time_aware_critic:
            demonstration["elapsed"] = 0.99 ** (torch.arange(80) % 20.0).unsqueeze(-1)
        env.set_seed(0)
    with Run.open(folder, {}, recipe="x") as run:
        sac = SAC(
            make_sac_agent(env, cfg, seed=0),
            cfg,
            steps=STEPS,
            folder=folder / "replay",
            demonstration=demonstration,
            relabel=transform if moving else None,
            relabel_episodes=transform if whole else None,
            scaling=ReturnScaling(0.99),
        )
        train_policy(env, sac, transform, seed=0, run=run)
        state = run.load("sac")
    state.pop("seconds")
    return state


# Runs


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        pytest.param("discrete", {}, marks=pytest.mark.slow),
        pytest.param("box", {"moving": True}, marks=pytest.mark.slow),
        ("box", {"whole": True, "time_aware_critic": True}),
        pytest.param("discrete", {"time_aware_critic": True}, marks=pytest.mark.slow),
        pytest.param("box", {"precision": "bf16"}, marks=pytest.mark.slow),
        pytest.param(
            *("box", {"entropy": "none", "normalise_observations": True}), marks=pytest.mark.slow
        ),
    ],
)
def test_a_run_stopped_again_and_again_ends_bit_for_bit_as_an_undisturbed_one(
    kind, settings, tmp_path
):
    expected = train(tmp_path / "whole", kind=kind, **settings)
    for number, how in ((2, Killed), (4, Interrupted), (7, Killed), (10, Interrupted)):
        with stopped(how, number * BATCH):
            train(tmp_path / "run", kind=kind, **settings)
        torch.manual_seed(1234 + number)  # As in a new process.
    found = train(tmp_path / "run", kind=kind, **settings)
    for one in (found, expected):  # Cut at each checkpoint, of which there were others.
        assert one["algorithm"]["replay"].pop("sums")
    assert_equal(found, expected)
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
    assert [row["step"] for row in rows(tmp_path / "run")] == list(range(64, STEPS + 1, 64))
    assert not (tmp_path / "run/replay").exists()


@pytest.mark.parametrize("moving", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", [pytest.param("discrete", marks=pytest.mark.slow), "box"])
def test_the_learner_cannot_see_the_true_reward(kind, moving, tmp_path):
    settings = {"kind": kind, "moving": moving, "known": True}
    expected = train(tmp_path / "true", **settings)
    for garbage in ("noise", "nan"):
        found = train(tmp_path / garbage, garbage=garbage, **settings)
        for name in ("algorithm", "transform", "rng"):
            # The checksums are of what is stored, which the true reward is not part of either.
            assert_equal(found[name], expected[name])
    found = {}
    for garbage in ("true", "noise", "nan"):
        told = (row.get("train/return_mean", 0.0) for row in rows(tmp_path / garbage))
        found[garbage] = [value for value in told if value != 0.0]
    assert found["true"] != found["noise"] and found["nan"] == [None] * len(found["true"])


def test_a_stored_reward_and_one_computed_anew_teach_the_same_where_the_model_stays(tmp_path):
    """Of a frozen reward module both are the same numbers, up to the rounding of another batch."""
    stored = train(tmp_path / "stored", known=True)["algorithm"]["loss"]
    anew = train(tmp_path / "anew", known=True, moving=True)["algorithm"]["loss"]
    other = train(tmp_path / "other", known=True, tau=0.1)["algorithm"]["loss"]
    name = next(name for name in stored if "qvalue" in name and name.endswith("0.weight"))
    torch.testing.assert_close(stored[name], anew[name], atol=1e-3, rtol=0)
    assert (stored[name] - other[name]).abs().max() > 1e-2


def test_a_moving_reward_is_that_of_now(tmp_path):
    """Once the module's weights change, minibatches of earlier transitions get other rewards."""
    env = GymVectorEnv(lambda: gymnasium.make("Pendulum-v1"), 4)
    reward = learned(env)
    transform = Compose(IntrinsicReward(reward))
    cfg = replace(CFG, random_steps=10_000)
    both = {}
    for name, relabel in (("stored", None), ("moving", transform)):
        sac = SAC(make_sac_agent(env, cfg, seed=0), cfg, steps=STEPS, relabel=relabel)
        torch.manual_seed(0)
        env.set_seed(0)
        batch = env.rollout(8, sac.act(), break_when_any_done=False)
        sac.update(transform(batch))
        torch.manual_seed(1)
        before = next(iter(sac._minibatches(1)))[3]
        with torch.no_grad():
            for parameter in reward.parameters():
                parameter.add_(0.1)
        torch.manual_seed(1)
        after = next(iter(sac._minibatches(1)))[3]
        with torch.no_grad():
            for parameter in reward.parameters():
                parameter.sub_(0.1)
        both[name] = before, after
    assert torch.equal(*both["stored"])
    assert not torch.allclose(*both["moving"])
    assert torch.allclose(both["stored"][0], both["moving"][0], atol=1e-5)


def test_episodes_that_are_held_back_are_stored_whole_once_they_end():
    """Each as one batch, of one environment, with the transitions that led there."""
    seen = []

    def relabel(episode):
        seen.append(episode.clone())
        return episode

    env = GymVectorEnv(lambda: gymnasium.make("CartPole-v1"), 4, max_episode_steps=30)
    cfg = replace(CFG, random_steps=10_000)
    sac = SAC(make_sac_agent(env, cfg, seed=0), cfg, steps=STEPS, relabel_episodes=relabel)
    torch.manual_seed(0)
    data = env.rollout(160, sac.act(), break_when_any_done=False)
    for part in data.split(8, 1):
        sac.update(part)
    assert sum(episode.numel() for episode in seen) == sac.replay.written > 400
    for episode in seen:
        done = episode["next", "done"][0, :, 0]
        assert done[-1] and not done[:-1].any()
        assert torch.equal(episode["observation"][:, 1:], episode["next", "observation"][:, :-1])
        assert not episode["next", "reward"].any()  # The true one, which is 1.
    ended = data["next", "done"].squeeze(-1)
    left = [160 - (int(row.nonzero()[-1]) + 1) for row in ended]
    assert data.numel() - sac.replay.written == sum(left)


@pytest.mark.parametrize("whole", [False, True])
def test_a_time_aware_critic_sees_the_discount_so_far(whole):
    """Before each transition and after it; the demonstration's own time beside the agent's."""
    env = GymVectorEnv(lambda: gymnasium.make("Pendulum-v1").unwrapped, 4, max_episode_steps=10)
    cfg = replace(CFG, batch=400, random_steps=10_000, time_aware_critic=True, gamma=0.9)
    known = transitions(20, dim=3)
    known["elapsed"] = torch.full((20, 1), 0.75)
    sac = SAC(
        *(make_sac_agent(env, cfg, seed=0), cfg),
        steps=STEPS,
        demonstration=known,
        relabel_episodes=(lambda episode: episode) if whole else None,
    )
    data = env.rollout(24, sac.act(), break_when_any_done=False)
    data["observation"][..., 0] = torch.arange(24) % 10  # Tells the time.
    data["next", "observation"][..., 0] = torch.arange(1, 25) % 10
    for part in data.split(8, 1):
        sac.update(part)
    drawn = dict(zip(sac.keys, next(iter(sac._minibatches(1))), strict=True))
    now, later = drawn["elapsed"], drawn["next", "elapsed"]
    told = drawn["observation"][:, :1]
    own = now != 0.75
    torch.testing.assert_close(now[own], 0.9 ** told[own])
    torch.testing.assert_close(later, now * 0.9)
    assert 0 < (~own).sum() < 100 and len(now[own].unique()) == 10


def test_the_time_changes_what_a_time_aware_critic_says_and_not_what_the_actor_does():
    agent = SACAgent(3, Bounded(-1, 1, shape=(1,)), hidden=[8])
    pair = transitions(5).rename_key_("action", "drawn_action")
    critic, values = agent.critic(time_aware=True), []
    for elapsed in (0.0, 1.0):
        values.append(
            critic(pair.set("elapsed", torch.full((5, 1), elapsed)))["state_action_value"]
        )
    assert not torch.isclose(*values).any()
    assert agent.acting().in_keys == agent.actor_for_loss().in_keys == ["observation"]


def test_the_demonstrations_time_begins_with_each_episode_and_counts_what_was_left_out():
    transitions = TensorDict({"episode": torch.tensor([0, 0, 0, 1, 1, 1, 1])}, [7])
    assert _steps(Demonstration(transitions)).flatten().tolist() == [0, 1, 2, 0, 1, 2, 3]


def test_gradient_steps_are_as_many_as_asked(tmp_path):
    """None while actions are random; then ``updates`` for each environment step."""
    state = train(tmp_path, updates=0.5)
    assert state["algorithm"]["updates"] == (STEPS - 64) // 2
    first, second = rows(tmp_path)[:2]
    assert "sac/loss_qvalue" not in first and "sac/loss_qvalue" in second


def test_actions_are_random_before_learning_begins():
    env = GymVectorEnv(lambda: gymnasium.make("Pendulum-v1"), 4)
    sac = SAC(make_sac_agent(env, CFG, seed=0), CFG, steps=STEPS)
    batch = env.rollout(200, sac.act(), break_when_any_done=False)
    assert batch["action"].abs().max() > 1.95  # Bounds of 2.
    assert batch["action"].std().item() == pytest.approx(4 / 12**0.5, abs=0.1)  # Uniform.


# Losses by hand


def transitions(n, *, dim=3, size=1, terminated=None):
    generator = torch.Generator().manual_seed(5)
    flag = torch.zeros(n, 1, dtype=torch.bool) if terminated is None else terminated
    return TensorDict(
        {
            "observation": torch.randn(n, dim, generator=generator),
            "action": torch.rand(n, size, generator=generator) * 2 - 1,
            "next": {
                "observation": torch.randn(n, dim, generator=generator),
                "reward": torch.randn(n, 1, generator=generator),
                "terminated": flag,
                "done": flag,
            },
        },
        [n],
    )


def soft_target(sac, batch, gamma=0.99):
    """``r + gamma (1 - terminated) (min Q'(s', a') - alpha log pi(a'|s'))`` with plain modules."""
    agent, loss = sac.agent, sac.loss
    distribution = agent.distribution(batch["next", "observation"])
    drawn, log_prob = distribution.rsample_and_log_prob()
    values = []
    for number in range(2):
        critic = agent.critic()
        with loss.target_qvalue_network_params[number].to_module(critic):
            pair = TensorDict(
                {"observation": batch["next", "observation"], "drawn_action": drawn}, batch.shape
            )
            values.append(critic(pair)["state_action_value"])
    value = torch.minimum(*values).squeeze(-1) - loss.log_alpha.exp() * log_prob
    alive = 1 - batch["next", "terminated"].float().squeeze(-1)
    return batch["next", "reward"].squeeze(-1) + gamma * alive * value


def test_the_critics_loss_is_the_squared_error_of_the_soft_target():
    cfg = replace(CFG, batch=6, random_steps=0)
    sac = SAC(SACAgent(3, Bounded(-1, 1, shape=(1,)), hidden=[8]), cfg, steps=100)
    ended = torch.tensor([[True], [False], [False], [True], [False], [False]])
    batch = transitions(6, terminated=ended)
    columns = [
        batch["observation"],
        batch["action"],
        *(batch["next", name] for name in ("observation", "reward", "done", "terminated")),
    ]
    torch.manual_seed(0)
    found = sac.gradients.step(columns)["loss_qvalue"]
    torch.manual_seed(0)
    with torch.no_grad():
        target = soft_target(sac, batch)
        expected = torch.zeros(())
        for number in range(2):
            critic = sac.agent.critic()
            with sac.loss.qvalue_network_params[number].to_module(critic):
                pair = TensorDict(
                    {"observation": batch["observation"], "drawn_action": batch["action"]}, [6]
                )
                value = critic(pair)["state_action_value"].squeeze(-1)
            expected += (value - target).square().mean()
    torch.testing.assert_close(found, expected)


def test_the_gradient_reaches_every_weight_and_targets_follow_slowly():
    cfg = replace(CFG, random_steps=0, tau=0.25)
    sac = SAC(SACAgent(3, Bounded(-1, 1, shape=(1,)), hidden=[8]), cfg, steps=STEPS)
    before = copy.deepcopy(sac.state_dict()["loss"])
    sac.update(transitions(32).unflatten(0, (4, 8)))
    after = sac.state_dict()["loss"]
    changed = {name for name in after if not torch.equal(after[name], before[name])}
    constant = {name for name in after if name.split(".")[-1] in CONSTANT}
    assert changed | constant == set(after)
    assert not changed & constant


@pytest.mark.parametrize("termination", ["ends", "bootstrap"])
def test_what_a_failure_is_worth(termination):
    """Nothing; or, as a time limit, what follows."""
    cfg = replace(CFG, batch=64, random_steps=10_000)
    sac = SAC(
        SACAgent(3, Bounded(-1, 1, shape=(1,)), hidden=[8]),
        cfg,
        steps=STEPS,
        termination=termination,
    )
    ended = torch.arange(32).unsqueeze(-1) % 2 == 0
    batch = transitions(32, terminated=ended)
    batch["next", "reward"] = ended.float() * 10  # Tells which transitions were drawn.
    sac.update(batch.unflatten(0, (4, 8)))
    *_, reward, _, terminated = next(iter(sac._minibatches(1)))
    assert set(reward.flatten().tolist()) == {0.0, 10.0}
    assert torch.equal(terminated, (reward > 0) & (termination == "ends"))


# Agents


@pytest.mark.parametrize(
    "spec", [Bounded(-0.5, 2.5, shape=(2,)), Categorical(3), OneHot(3)], ids=["box", "int", "hot"]
)
def test_log_probabilities_are_those_of_the_actions_drawn(spec):
    torch.manual_seed(0)
    agent = SACAgent(4, spec, hidden=[8])
    observation = torch.randn(1, 4).expand(60_000, 4)
    (action,) = agent.act(observation)
    with torch.no_grad():
        log_prob = agent.log_prob(observation, action)
    if agent.discrete:
        index = action.argmax(-1) if agent.one_hot else action
        share = torch.bincount(index, minlength=3) / len(index)
        expected = torch.stack([log_prob[index == i].exp().mean() for i in range(3)])
        torch.testing.assert_close(share, expected, atol=0.01, rtol=0)
    else:
        assert action.min() > -0.5 and action.max() < 2.5
        # The density of the scaled action integrates to 1: E[1 / p(a)] is the volume, 2 x 2.
        density = log_prob.exp()
        assert (1 / density).mean().item() == pytest.approx(4.0, rel=0.15)
    greedy, again = (agent.act(observation[:5], greedy=True)[0] for _ in range(2))
    assert torch.equal(greedy, again)


def test_a_saved_agent_plays_as_before(tmp_path):
    agent = SACAgent(4, Bounded(-2, 2, shape=(2,)), hidden=[8], normalise=True)
    agent.update_normaliser(torch.randn(50, 4) * 3 + 1)
    loaded = SACAgent.from_pretrained(agent.save_pretrained(tmp_path / "p"))
    x = torch.randn(7, 4)
    assert torch.equal(loaded.act(x, greedy=True)[0], agent.act(x, greedy=True)[0])


def test_its_score_is_that_of_the_mean_action():
    task = TaskConfig(name="pendulum", env_id="Pendulum-v1", max_episode_steps=20)
    agent = SACAgent(3, Bounded(-2, 2, shape=(1,)), hidden=[8])
    both = evaluate_both(agent, task, episodes=3, seed=0)
    for scores, mode in ((both, True), (both["sampled"], False)):
        alone = evaluate(agent, task, episodes=3, seed=0, deterministic=mode, show_progress=False)
        assert scores["returns"] == alone.returns
    assert both["returns"] != both["sampled"]["returns"]


@pytest.mark.parametrize(
    "spec",
    [Unbounded((2,)), Bounded(torch.tensor([-1.0, -torch.inf]), torch.ones(2), shape=(2,))],
    ids=["unbounded", "half"],
)
def test_actions_without_bounds_are_refused(spec):
    with pytest.raises(UserError, match="set algorithm=ppo"):
        SACAgent(4, spec)


@pytest.mark.slow
def test_pendulum_is_learned(tmp_path):
    """On the true reward, about -1,200 at the start and -150 at the best."""
    cfg = replace(SACConfig(), random_steps=500, updates=1.0, hidden=[64, 64])
    env = GymVectorEnv(lambda: gymnasium.make("Pendulum-v1"), 8)
    with Run.open(tmp_path, {}, recipe="x") as run:
        sac = SAC(make_sac_agent(env, cfg, seed=0), cfg, steps=15_000)
        train_policy(env, sac, Compose(), seed=0, run=run)
    returns = [row["train/return_mean"] for row in rows(tmp_path) if "train/return_mean" in row]
    assert returns[0] < -800
    assert sum(returns[-3:]) / 3 > -300
