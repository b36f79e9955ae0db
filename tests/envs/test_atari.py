import re

import gymnasium
import numpy as np
import pytest
import torch
import yaml
from gymnasium.wrappers import AtariPreprocessing
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import check_env_specs

from giril_rl.config.recipes import shipped_conf
from giril_rl.config.schema import TaskConfig
from giril_rl.envs import AtariEnv, AtariGymEnv, for_scores, gym_factory, make_env
from giril_rl.envs.atari import Opened
from giril_rl.envs.atari_preprocessing import AtariGame
from giril_rl.errors import UserError
from giril_rl.runs.randomness import stream_seed
from giril_rl.training import evaluate

ale_py = pytest.importorskip("ale_py")
gymnasium.register_envs(ale_py)

BREAKOUT = TaskConfig(name="breakout", env_id="ALE/Breakout-v5")
IDS = {
    "space_invaders": "SpaceInvaders",
    "beam_rider": "BeamRider",
    "breakout": "Breakout",
    "qbert": "Qbert",
    "seaquest": "Seaquest",
    "kung_fu_master": "KungFuMaster",
}
ACTIONS = {
    "space_invaders": 6,
    "beam_rider": 9,
    "breakout": 4,
    "qbert": 6,
    "seaquest": 18,
    "kung_fu_master": 14,
}


def test_shipped_games_are_these_with_whole_batches_of_steps():
    for name, game in IDS.items():
        task = TaskConfig(**yaml.safe_load((shipped_conf() / "task" / f"{name}.yaml").read_text()))
        assert (task.name, task.env_id) == (name, f"ALE/{game}-v5")
        batch = 8 * 128
        assert task.steps == 50_000_000 // batch * batch
        assert task.expert_steps == 10_000_000 // batch * batch


def raw_env(game):
    return gymnasium.make(
        f"ALE/{IDS[game]}-v5", frameskip=1, repeat_action_probability=0.0, full_action_space=False
    )


def in_step_with(game, env):
    """Gymnasium's own preprocessing, after as many frames without action as ``game`` began with."""
    gym_env = AtariPreprocessing(env, noop_max=0, frame_skip=4)
    gym_env.reset(seed=0)
    info = game._ale.reset([0], [3])[1]
    for _ in range(int(info["episode_frame_number"][0])):
        env.unwrapped.step(0)
    return gym_env


@pytest.mark.parametrize("name", IDS)
def test_frames_rewards_and_ends_are_those_of_gymnasiums_preprocessing(name):
    game = AtariGame(name)
    gym_env = in_step_with(game, raw_env(name))
    rng = np.random.default_rng(0)
    total, steps = 0.0, 0
    for _ in range(250):
        action = int(rng.integers(len(game.meanings)))
        shown = game.play(action)
        frame, reward, over, _, info = gym_env.step(action)
        assert np.array_equal(shown.frame, frame)
        assert (shown.reward, shown.over, shown.lives) == (reward, over, info["lives"])
        total, steps = total + reward, steps + 1
        if over:
            break
    assert steps > 100
    assert len(game.meanings) == ACTIONS[name]
    assert game.fires == (name != "kung_fu_master")


def play(env, steps, seed=0):
    """A rollout of random actions, as a collector steps: batch ``(num_envs, steps)``."""
    generator = torch.Generator().manual_seed(seed)
    count, root, batch = env.action_spec.space.n, env.reset(), []
    for _ in range(steps):
        root.set("action", torch.randint(count, env.batch_size, generator=generator))
        after, root = env.step_and_maybe_reset(root)
        batch.append(after.clone())
    return torch.stack(batch, 1)


@pytest.mark.parametrize("episode", ["life", "game"])
def test_specs(episode):
    for stop in (True, False):
        check_env_specs(AtariEnv("breakout", 2, episode=episode), break_when_any_done=stop)


def test_a_lost_life_ends_an_episode_with_its_own_last_stack_and_not_the_game():
    batch = play(AtariEnv("breakout", 3, seed=1), 250)
    following = batch["next", "observation"]
    done = batch["next", "done"].squeeze(-1)
    over = batch["next", "game_over"].squeeze(-1)
    assert done.sum() > over.sum() > 0 and not (over & ~done).any()
    assert torch.equal(done, batch["next", "terminated"].squeeze(-1))
    assert torch.equal(done, batch["next", "life_over"].squeeze(-1))
    # The end's stack continues that life's: no jump to what comes after.
    assert torch.equal(following[..., :3, :, :], batch["observation"][..., 1:, :, :])
    assert (following[done][:, 2:].flatten(1).float().mean(1) > 0).all()
    # Within an episode the next observation is the next step's; after its end it is not.
    same = (following[:, :-1] == batch["observation"][:, 1:]).flatten(2).all(-1)
    assert torch.equal(same, ~done[:, :-1])
    # A new life begins with one frame and black.
    first = batch["observation"][:, 1:][done[:, :-1]]
    assert (first[:, :3] == 0).all() and (first[:, 3] > 0).flatten(1).any(1).all()


def test_after_a_lost_life_the_game_goes_on_and_after_a_game_another_begins():
    """Breakout's bricks, rows 24 to 37, stay broken over lives and are whole in a new game."""
    env = AtariEnv("breakout", 1, seed=0)

    def bricks(frame):
        return int((frame[24:38] > 0).sum())

    root, generator = env.reset(), torch.Generator().manual_seed(0)
    whole, lives, seen = bricks(root["observation"][0, -1]), [], {"life": 0, "game": 0}
    while seen["game"] < 2:
        root.set("action", torch.randint(4, (1,), generator=generator))
        after, root = env.step_and_maybe_reset(root)
        if after["next", "done"].item():
            before = bricks(after["next", "observation"][0, -1])
            now = bricks(root["observation"][0, -1])
            over = after["next", "game_over"].item()
            seen["game" if over else "life"] += 1
            lives.append(int(env.lives[0]))
            assert now == (whole if over else before)
    assert seen["life"] == 8 and lives == [4, 3, 2, 1, 5, 4, 3, 2, 1, 5]


@pytest.mark.parametrize("name", ["breakout", "space_invaders", "kung_fu_master"])
def test_whole_game_scores_are_those_of_a_plain_loop(name):
    """The same game step by step by hand: all lives, unclipped."""
    task = TaskConfig(name=name, env_id=f"ALE/{IDS[name]}-v5")
    env = make_env(for_scores(task), 1, seed=5)
    generator = torch.Generator().manual_seed(0)
    actions, score, root = [], 0.0, env.reset()
    while True:
        action = torch.randint(ACTIONS[name], (1,), generator=generator)
        actions.append(int(action))
        root.set("action", action)
        after, root = env.step_and_maybe_reset(root)
        score += after["next", "reward"].item()
        if after["next", "done"].item():
            break
    assert after["next", "game_over"].item()

    game = AtariGame(name)
    _, lives = game.reset(stream_seed("training", 5, 0, 0, bits=32))
    plain = 0.0
    opening = [1, 2] if game.fires else []
    for action in opening:
        game.play(action)
    for action in actions:
        shown = game.play(action)
        plain += shown.reward
        if 0 < shown.lives < lives and not shown.over:
            for extra in (0, *opening):
                shown = game.play(extra)
                plain += shown.reward
        lives = shown.lives
    assert shown.over and plain == score and score > 0


class Watching:
    """Chooses by what it sees, so that each game is played in its own way."""

    def acting(self):
        return TensorDictModule(
            lambda seen: seen[:, -1].long().sum((1, 2)) % 4, ["observation"], ["action"]
        )


def test_scores_of_an_evaluation_are_those_of_plain_loops():
    """Games of different lengths, played side by side until the last one is over."""
    scores = evaluate(Watching(), BREAKOUT, episodes=4, seed=7, deterministic=True)
    returns, steps, lost = [], 0, 0
    for number in range(4):
        game = AtariGame("breakout")
        _, lives = game.reset(stream_seed("evaluation", 7, number, 0, bits=32))
        shown, score = [game.play(action) for action in (1, 2)][-1], 0.0
        while not shown.over:
            shown = game.play(int(shown.frame.astype(np.int64).sum()) % 4)
            score, steps = score + shown.reward, steps + 1
            if shown.lives < lives:
                lost += 1
            if 0 < shown.lives < lives:
                for action in (0, 1, 2):
                    before, shown = shown.lives, game.play(action)
                    score += shown.reward
                    assert shown.lives == before
            lives = shown.lives
        returns.append(score)
    assert scores.returns == returns and len(set(returns)) > 1
    assert scores.life_length_mean == pytest.approx(steps / lost) and lost == 20


def test_lost_lives_show_in_whole_games_too():
    env = AtariEnv("breakout", 1, episode="game", seed=0)
    batch = play(env, 500)
    over, lost = (batch["next", key].squeeze() for key in ("game_over", "life_over"))
    assert over.sum() >= 2 and not (over & ~lost).any()
    ends = over.nonzero().squeeze(-1).tolist()
    assert lost[: ends[0] + 1].sum() == lost[ends[0] + 1 : ends[1] + 1].sum() == 5


def test_an_opening_that_reaches_the_frame_cap_cuts_the_game(monkeypatch):
    """The step after a lost life is the game's last: neither a success of death nor lost."""
    env = AtariEnv("breakout", 1, episode="game", seed=0)
    root = env.reset()
    monkeypatch.setattr(env, "_begin_lives", lambda indices: opened)
    for cut in (True, False):
        ended = np.array([True])
        opened = Opened(np.array([3.0], dtype=np.float32), ended & (not cut), ended & cut)
        lost = False
        while not lost:
            root.set("action", torch.zeros(1, dtype=torch.int64))
            after, root = env.step_and_maybe_reset(root)
            lost = after["next", "life_over"].item()
        found = {key: after["next", key].item() for key in ("done", "terminated", "truncated")}
        assert found == {"done": True, "terminated": not cut, "truncated": cut}
        assert after["next", "game_over"].item() and after["next", "reward"].item() == 3.0


def test_a_game_is_cut_at_the_frame_cap():
    env = AtariEnv("breakout", 1, episode="game", frame_cap=60)
    batch = play(env, 15)
    ends = batch["next", "truncated"].squeeze(-1)[0]
    # 60 frames are 15 steps, two of which open the game.
    assert ends.nonzero().tolist() == [[12]] and not batch["next", "terminated"].any()
    assert torch.equal(ends, batch["next", "done"].squeeze(-1)[0])
    assert torch.equal(ends, batch["next", "game_over"].squeeze(-1)[0])


@pytest.mark.parametrize("name", IDS)
def test_a_game_begins_the_same_whatever_was_played_before(name):
    games, shown = [AtariGame(name), AtariGame(name)], []
    for game, steps in zip(games, (0, 120), strict=True):
        game.reset(seed=3)
        for step in range(steps):
            game.play(step % len(game.meanings))
        frames = [game.reset()[0]]
        frames += [game.play(step % len(game.meanings)).frame for step in range(40)]
        shown.append(np.stack(frames))
    assert np.array_equal(*shown)


def test_games_are_seeded_now_and_then(monkeypatch):
    monkeypatch.setattr("giril_rl.envs.atari.RESEED_EVERY", 2)
    seeds, begin = [], AtariGame.reset
    monkeypatch.setattr(
        AtariGame, "reset", lambda self, seed=None: (seeds.append(seed), begin(self, seed))[1]
    )
    env = AtariEnv("breakout", 1, seed=4)
    for _ in range(5):
        env.reset()
    first, third, fifth = (stream_seed("training", 4, 0, game, bits=32) for game in (0, 2, 4))
    assert seeds == [first, None, third, None, fifth]


@pytest.mark.parametrize("cap", [pytest.param(108_000, marks=pytest.mark.slow), 160])
@pytest.mark.parametrize("episode", ["life", "game"])
def test_a_restored_env_goes_on_as_the_first_would_have(episode, cap, monkeypatch):
    """With the lower cap many games begin, some of them seeded and some not."""
    monkeypatch.setattr("giril_rl.envs.atari.RESEED_EVERY", 2)
    first = AtariEnv("breakout", 3, episode=episode, seed=2, frame_cap=cap)
    play(first, 130)
    state = first.simulator_state()
    assert all(isinstance(value, (int, torch.Tensor)) for value in state.values())
    second = AtariEnv("breakout", 3, episode=episode, seed=99, frame_cap=cap)
    assert second.restore_simulator(state)
    roots = [first._root(torch.from_numpy(first._last_observation.copy())), second.reset()]
    generator = torch.Generator().manual_seed(7)
    ended = 0
    for _ in range(150):
        action = torch.randint(4, (3,), generator=generator)
        afters = []
        for i, env in enumerate((first, second)):
            roots[i].set("action", action)
            after, roots[i] = env.step_and_maybe_reset(roots[i])
            afters.append(after)
        assert (afters[0] == afters[1]).all()
        ended += int(afters[0]["next", "done"].sum())
    assert ended > 3


def test_a_replay_that_ends_elsewhere_begins_the_next_games():
    env = AtariEnv("breakout", 2, seed=3)
    play(env, 20)
    state = env.simulator_state()
    state["actions"] = state["actions"].clone().fill_(3)
    other = AtariEnv("breakout", 2)
    assert not other.restore_simulator(state)
    env._between[:] = False
    assert torch.equal(other.reset()["observation"], env.reset()["observation"])
    assert torch.equal(other.simulator_state()["episode"], state["episode"] + 1)


def test_a_replay_stops_where_a_game_ends_too_early(monkeypatch):
    env = AtariEnv("breakout", 1)
    play(env, 20)
    receive, received = AtariGame.receive, []

    def over_at_once(game):
        received.append(receive(game))
        return received[-1]._replace(over=len(received) == 1)

    monkeypatch.setattr(AtariGame, "receive", over_at_once)
    assert not AtariEnv("breakout", 1).restore_simulator(env.simulator_state())
    assert len(received) == 1 + 2  # The rest is the next game's opening.


@pytest.fixture(scope="module")
def saved():
    env = AtariEnv("breakout", 2, frame_cap=400)
    play(env, 12)
    return env.simulator_state()


def with_action(where, action):
    def change(state):
        state["actions"][where] = action

    return change


DAMAGED = {
    "an action beyond the last": (with_action((0, 3), 4), "not between 0 and 3"),
    "a large action": (with_action((1, 0), 32767), "not between 0 and 3"),
    "an action below -1": (with_action((0, 3), -2), "not between 0 and 3"),
    "a gap": (with_action((0, 3), -1), "with -1 after the last"),
    "real actions": (lambda s: s.update(actions=s["actions"].float()), "not int16"),
    "actions of three games": (lambda s: s.update(actions=s["actions"][[0, 1, 1]]), "not int16"),
    "one action": (lambda s: s.update(actions=s["actions"][0, 0]), "not int16 of shape [2, time]"),
    "more actions than a game has": (
        lambda s: s.update(actions=torch.zeros(2, 101, dtype=torch.int16)),
        "more than the 100 steps",
    ),
    "no actions": (lambda s: s.pop("actions"), "'actions' is not a tensor"),
    "lives of another type": (lambda s: s.update(lives=s["lives"].float()), "'lives' is not int64"),
    "words": (lambda s: s.update(between="no"), "'between' is not a tensor"),
    "small frames": (
        lambda s: s.update(observation=s["observation"][..., :80]),
        "'observation' is not uint8 of shape [2, 4, 84, 84]",
    ),
    "games that never began": (lambda s: s["episode"].zero_(), "'episode' is not at least 1"),
    "a seed below zero": (lambda s: s.update(seed=-1), "seed is not a natural number"),
    "a seed that is none": (lambda s: s.update(seed=True), "seed is not a natural number"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_state_is_refused_before_anything_is_played(case, saved, monkeypatch):
    """ale-py waits forever for what an action that it does not have leads to."""
    change, sentence = DAMAGED[case]
    state = {k: v.clone() if isinstance(v, torch.Tensor) else v for k, v in saved.items()}
    env = AtariEnv("breakout", 2, frame_cap=400)
    monkeypatch.setattr(AtariGame, "reset", None)
    monkeypatch.setattr(AtariGame, "send", None)
    change(state)
    with pytest.raises(ValueError, match=re.escape(sentence)):
        env.restore_simulator(state)


@pytest.mark.parametrize("action", [-1, 4])
def test_a_game_refuses_an_action_that_it_does_not_have(action):
    game = AtariGame("breakout")
    game.reset(seed=0)
    with pytest.raises(ValueError, match="only 0 to 3"):
        game.play(action)
    assert game.play(3).lives == 5


def test_games_of_one_batch_differ_and_a_seed_repeats_them():
    one, again, other = (play(AtariEnv("seaquest", 2, seed=s), 60) for s in (0, 0, 1))
    assert (one == again).all()
    assert not torch.equal(one["observation"], other["observation"])
    assert not torch.equal(one["observation"][0], one["observation"][1])


def test_a_batch_keeps_what_it_was_given():
    """Openings rewrite stacks: those that were handed out before stay as they were."""
    env = AtariEnv("breakout", 2, seed=1)
    generator, root, kept = torch.Generator().manual_seed(0), env.reset(), []
    for _ in range(120):
        root.set("action", torch.randint(4, (2,), generator=generator))
        after, root = env.step_and_maybe_reset(root)
        kept.append((after["next", "observation"], after["next", "observation"].clone()))
    assert all(torch.equal(now, then) for now, then in kept)


def test_the_gymnasium_form_shows_the_same():
    make = gym_factory(BREAKOUT)
    env, batched = make(), AtariEnv("breakout", 1, seed=11)
    root = batched.reset()
    observation, info = env.reset(seed=11)
    assert np.array_equal(observation, root["observation"][0]) and info["lives"] == 5
    assert env.spec.id == "ALE/Breakout-v5" and env.observation_space.contains(observation)
    rng = np.random.default_rng(0)
    for _ in range(60):
        action = int(rng.integers(4))
        observation, reward, terminated, truncated, info = env.step(action)
        after = batched._step(TensorDict({"action": torch.tensor([action])}, [1]))
        assert np.array_equal(observation, after["observation"][0])
        assert (reward, terminated, truncated) == (
            after["reward"].item(),
            after["terminated"].item(),
            after["truncated"].item(),
        )
        if terminated:
            break
    assert terminated and info["lives"] == 4


def test_refusals():
    with pytest.raises(UserError, match="is not a Gymnasium id; did you mean 'ALE/Breakout-v5'"):
        make_env(TaskConfig(name="x", env_id="ALE/Brekout-v5"), 1, seed=0)
    with pytest.raises(UserError, match="brekout is not a game of ale-py; did you mean 'breakout'"):
        AtariGame("brekout")
    with pytest.raises(UserError, match="choose one of life, game"):
        AtariGymEnv("breakout", episode="lives")
