"""Playing with noise, and whether the reward of D-REX orders what it has not seen."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from scipy.stats import spearmanr
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from giril_rl.config.schema import FitConfig, TaskConfig
from giril_rl.envs import make_env
from giril_rl.errors import UserError
from giril_rl.rewards.drex import DREXConfig, PreferenceLoss, drex_reward
from giril_rl.rewards.preferences import snippet_pairs
from giril_rl.runs.metrics import read_metrics
from giril_rl.runs.run import Run
from giril_rl.training import fit_reward
from giril_rl.training.ranking import (
    CloneConfig,
    RankedEpisodes,
    RankingConfig,
    play_with_noise,
    ranked_episodes,
)


class Cart(gymnasium.Env):
    """A push in [-1, 1] moves a cart with friction; the reward is its speed."""

    def __init__(self, bound=1.0):
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Box(-bound, bound, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-0.1, 0.1, 2)
        return self.state.astype(np.float32), {}

    def step(self, action):
        place, speed = self.state
        speed = 0.8 * speed + 0.2 * float(action[0])
        self.state = np.array([place + 0.1 * speed, speed])
        return self.state.astype(np.float32), speed, False, False, {}


gymnasium.register("Cart-v0", entry_point=Cart, max_episode_steps=60)
gymnasium.register("Unbounded-v0", lambda: Cart(np.inf), max_episode_steps=60)
TASK = TaskConfig(name="cart", env_id="Cart-v0")
COUNTER = TaskConfig(name="counter", env_id="StepCounter-v0")


def pushing(force):
    """A policy that always pushes alike."""
    return TensorDictModule(
        lambda seen: torch.full((*seen.shape[:-1], 1), force),
        in_keys=["observation"],
        out_keys=["action"],
    )


def played(force, noise, *, task=TASK, seed=0):
    return play_with_noise(
        pushing(force), task, torch.tensor(noise), seed=seed, show_progress=False
    )


def test_without_noise_the_policy_plays_and_with_all_of_it_chance():
    out = played(0.5, [0.0, 1.0, 0.3])
    assert out.lengths.tolist() == [60, 60, 60]
    none, all_of_it, some = out.transitions["action"].flatten().split(60)
    assert (none == 0.5).all()
    assert (all_of_it != 0.5).all() and all_of_it.abs().max() <= 1
    assert all_of_it.mean().abs() < 0.3 and all_of_it.std() == pytest.approx(3**-0.5, abs=0.15)
    assert 6 <= (some != 0.5).sum() <= 32  # 18 on average.


def test_returns_are_the_true_ones_and_episodes_follow_each_other():
    out = played(0.5, [0.0, 0.5])
    place, speed = out.transitions["observation"].unbind(-1)
    for i in range(2):
        own, step = speed[60 * i : 60 * (i + 1)], out.transitions["action"][60 * i + 59]
        last = 0.8 * own[-1] + 0.2 * step
        assert out.returns[i].item() == pytest.approx((own[1:].sum() + last).item(), rel=1e-4)
        torch.testing.assert_close(place[60 * i + 1] - place[60 * i], 0.1 * own[1])


def test_episodes_of_different_length_are_cut_where_they_end():
    out = played(0.0, [0.0] * 25, task=COUNTER)  # More than are played at once.
    assert len(out.lengths.unique()) > 3 and int(out.lengths.sum()) == len(out.transitions)
    parts = out.transitions["observation"].split(out.lengths.tolist())
    for part, length in zip(parts, out.lengths.tolist(), strict=True):
        assert part[:, 1].tolist() == list(range(length))
        assert len(part[:, 0].unique()) == 1
    starts = torch.stack([part[0, 0] for part in parts])
    assert len(starts.unique()) == 25  # Each episode has a seed of its own.
    assert out.returns[0] == sum(100.0 * (i + 1) for i in range(int(out.lengths[0])))


def test_it_follows_from_its_seed_and_leaves_the_global_generator_alone():
    state = torch.get_rng_state()
    one = played(0.5, [0.5, 0.9])
    assert torch.equal(torch.get_rng_state(), state)
    torch.rand(3)
    two, three = played(0.5, [0.5, 0.9]), played(0.5, [0.5, 0.9], seed=1)
    assert (one.transitions == two.transitions).all()
    assert not torch.equal(one.transitions["action"], three.transitions["action"])


def test_the_fixed_horizon_scores_the_tasks_own_episode():
    task = TaskConfig(
        name="counter", env_id="StepCounter-v0", max_episode_steps=30, horizon="fixed"
    )
    out = played(0.0, [0.0] * 3, task=task)
    assert out.lengths.tolist() == [30] * 3
    assert (out.returns < 100 * 12 * 13 / 2 + 1).all()  # At most 11 steps until the first failure.


def test_actions_without_bounds_are_refused():
    task = TaskConfig(name="unbounded", env_id="Unbounded-v0")
    with pytest.raises(UserError, match="actions without bounds have no uniform distribution"):
        played(0.5, [0.0], task=task)


def test_a_kept_file_must_fit_together():
    state = played(0.5, [0.0, 0.5]).state_dict()
    again = RankedEpisodes.from_state(state)
    assert (again.transitions == played(0.5, [0.0, 0.5]).transitions).all()
    for wrong in ({"lengths": torch.tensor([60, 61])}, {"noise": torch.zeros(3)}):
        with pytest.raises(ValueError, match="its "):
            RankedEpisodes.from_state({**state, **wrong})


def test_the_summary_says_whether_noise_made_it_worse():
    parts = TensorDict({"observation": torch.zeros(4, 1), "action": torch.zeros(4, 1)}, [4])
    ones, noise = torch.ones(4, dtype=torch.int64), torch.tensor([0.0, 0.0, 0.5, 0.5])
    right = RankedEpisodes(parts, noise, ones, torch.tensor([4.0, 3.0, 2.0, 1.0])).summary()
    assert right["steps"] == 4 and right["noise"] == [0.0, 0.5]
    assert right["return_means"] == [3.5, 1.5]
    assert right["rank_correlation"] > 0.85  # Ties of noise leave it below 1.
    wrong = RankedEpisodes(parts, noise, ones, torch.tensor([1.0, 2.0, 3.0, 4.0])).summary()
    assert wrong["rank_correlation"] == -right["rank_correlation"]
    assert RankedEpisodes(parts, noise, ones, torch.ones(4)).summary()["rank_correlation"] is None


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """The reward of a demonstrator that pushes with half of what it could, and what was played."""
    torch.manual_seed(0)
    pairs = played(0.5, [0.0] * 3, seed=7).transitions
    with Run.open(tmp_path_factory.mktemp("drex") / "run", {}, recipe="drex") as run:
        ranked = ranked_episodes(
            pairs,
            TASK,
            RankingConfig(levels=10, episodes=3),
            CloneConfig(steps=300, hidden=[16]),
            seed=0,
            run=run,
        )
        settings = DREXConfig(members=2, hidden=[32], pairs=500, snippet=20)
        env = make_env(TASK, 1, 0)
        reward = drex_reward(settings, env, pairs, seed=0)
        reward.scaler.fit(ranked.transitions["observation"])
        fitted, unseen = snippet_pairs(
            ranked.noise, ranked.lengths, members=2, pairs=500, snippet=20, margin=0.3, seed=0
        )
        loss = PreferenceLoss(reward, ranked.transitions)
        fit_reward(
            loss,
            fitted,
            FitConfig(steps=400, batch=32, lr=1e-3, log_every=100),
            seed=0,
            run=run,
            validation=unseen,
        )
        reward.calibrate(ranked.transitions)
    return reward, ranked, read_metrics(run.folder / "metrics.jsonl")


def sums(reward, episodes):
    """What the learned reward pays for each episode."""
    paid = reward(episodes.transitions.clone())["next", "intrinsic_reward"].detach()
    return torch.stack([part.sum() for part in paid.split(episodes.lengths.tolist())])


def test_the_learned_reward_orders_unseen_episodes(learned):
    reward, ranked, _ = learned
    assert ranked.summary()["rank_correlation"] > 0.8  # The premise.
    noise = torch.linspace(0, 1, 40).tolist()
    unseen = played(0.5, noise, seed=99)
    assert spearmanr(sums(reward, unseen), unseen.returns).statistic > 0.8
    pushes = [-1.0, -0.5, 0.0, 0.25, 0.5]
    others = torch.stack([sums(reward, played(push, [0.2] * 3, seed=5)).mean() for push in pushes])
    assert (others.diff() > 0).all()


def test_it_pays_more_for_what_is_better_than_the_demonstrator(learned):
    reward, ranked, _ = learned
    best = sums(reward, ranked).max()
    faster = played(1.0, [0.0] * 3, seed=3)
    assert faster.returns.min() > 1.5 * ranked.returns.max()
    assert (sums(reward, faster) > best).all()


def test_the_log_shows_the_premise_and_the_fit(learned):
    *_, rows = learned
    ranking = [row for row in rows if row["phase"] == "ranking"]
    assert [row["step"] for row in ranking] == [180 * (i + 1) for i in range(10)]
    assert [row["ranking/noise"] for row in ranking] == pytest.approx([i / 10 for i in range(10)])
    assert ranking[0]["ranking/return_mean"] > ranking[-1]["ranking/return_mean"] + 10
    fit = [row for row in rows if row["phase"] == "fit"][-1]
    assert fit["fit/held_out/accuracy"] > 0.9
