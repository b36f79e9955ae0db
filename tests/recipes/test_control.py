"""Every control from its command to its result, with settings so small that nothing is learned."""

import json
import math

import gymnasium
import pytest
from short_runs import rows, weights

from giril_rl.cli.command_line import main
from giril_rl.config.recipes import copy, find
from giril_rl.config.schema import TaskConfig
from giril_rl.envs import GymVectorEnv, make_env
from giril_rl.runs.checkpoint import load_state
from giril_rl.runs.metrics import read_metrics
from giril_rl.runs.run import Run

REWARDS = [
    *("constant", "untrained_giril", "untrained_icm", "copy", "noise", "negated_giril"),
    *("centred_giril", "random", "held_action"),
]
UNTRAINED = ("random", "held_action")
QUICK = ("constant", "negated_giril", *UNTRAINED)
"""The others are slow tests, and CI runs every control besides."""
TINY = [
    *("steps=256", "ppo.num_envs=2", "ppo.rollout=64", "ppo.minibatch=64", "ppo.epochs=1"),
    *("ppo.hidden=[16,16]", "ppo.checkpoint_every=128", "eval.episodes=2", "logger=null"),
    *("expert.steps=2000", "demo.length=100", "demo.subsample=2", "fit.steps=20"),
    *("fit.log_every=10", "task.env_id=CartPole-v1"),
]

RESULT = {
    *("method", "task", "profile", "seed", "seeds", "env_steps", "return_mean", "return_std"),
    *("return_median", "episode_length_mean", "episodes", "returns", "deterministic"),
    *("wall_seconds", "fit_seconds", "steps_per_second", "expert_return_mean", "demo_return_mean"),
    *("demo_transitions", "config_hash", "versions", "finished_at"),
    *("algorithm", "score_over_demo"),
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Where this file's runs share one expert and one demonstration."""
    return tmp_path_factory.mktemp("runs")


def test_a_copy_is_a_method_of_its_own_and_has_no_profile_where_nothing_is_averaged(root, tmp_path):
    file, _ = copy(find("control"), tmp_path / "mine.py")
    result = run(str(file), tmp_path / "random", root, "reward=random")
    assert (result["method"], result["profile"]) == ("mine", None)
    assert main(["eval", str(tmp_path / "random")]) == 0
    result = run(str(file), tmp_path / "averaged", root)
    assert (result["method"], result["profile"]) == ("mine", "released")
    text = file.read_text()
    averaging = "*[BatchMeanReward()] * cfg.batch_mean,"
    assert averaging in text
    text = text.replace("seeds=seeds", 'seeds=seeds, method="giril"')
    file.write_text(text.replace(averaging, ""))
    with pytest.warns(DeprecationWarning, match=r"finish_run\(method=...\) is now not read"):
        result = run(str(file), tmp_path / "not_averaged", root)
    assert (result["method"], result["profile"]) == ("mine", None)
    card = json.loads((tmp_path / "not_averaged" / "policy" / "card.json").read_text())
    assert (card["method"], card["profile"]) == ("mine", None)


def run(recipe, out, root, *more, code=0):
    by_key = {word.split("=")[0]: word for word in [*TINY, *more]}
    assert main(["run", recipe, f"out={out}", f"root={root}", *by_key.values()]) == code
    return json.loads((out / "result.json").read_text()) if code == 0 else None


def starts(seed, episodes):
    """CartPole's first states as an evaluation draws them."""
    env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), episodes, seed)
    found = env.reset()["observation"].double().tolist()
    env.close()
    return found


def first_batch(folder):
    """The mean reward of the first batch, which an untrained policy played."""
    rows = [row for row in read_metrics(folder / "metrics.jsonl") if row["phase"] == "ppo"]
    return rows[0]["ppo/reward_mean"]


@pytest.mark.parametrize(
    "reward", [r if r in QUICK else pytest.param(r, marks=pytest.mark.slow) for r in REWARDS]
)
def test_each_control_leaves_a_whole_result(reward, root, tmp_path):
    result = run("control", tmp_path / "run", root, f"reward={reward}")
    assert result.keys() >= RESULT
    assert result["method"] == f"control:{reward}"
    assert result["env_steps"] == (0 if reward in UNTRAINED else 256)
    assert result["algorithm"] == (None if reward in UNTRAINED else "ppo")
    needs_demo = reward not in ("constant", *UNTRAINED)
    assert result["demo_transitions"] == (100 if needs_demo else None)
    assert (result["expert_return_mean"] is not None) == needs_demo
    seeds = {"policy", "evaluation"} | ({"expert", "demo"} if needs_demo else set())
    seeds |= {"reward"} if needs_demo and reward != "copy" else set()
    assert set(result["seeds"]) == seeds
    for scores in (result, result["deterministic"]):
        assert math.isfinite(scores["return_mean"]) and len(scores["returns"]) == 2
    assert main(["eval", str(tmp_path / "run")]) == 0
    again = json.loads((tmp_path / "run" / "eval.json").read_text())
    assert again["returns"] == result["returns"]


@pytest.mark.parametrize("reward", ["constant", *UNTRAINED])
def test_no_expert_is_made_where_none_is_needed(reward, tmp_path):
    run("control", tmp_path / "run", tmp_path / "root", f"reward={reward}")
    assert not (tmp_path / "root").exists()


def test_a_random_policy_trains_nothing_and_is_scored_on_the_same_episodes(
    root, tmp_path, monkeypatch
):
    result = run("control", tmp_path / "run", root, "reward=random", "eval.episodes=3")
    assert result["seeds"]["evaluation"] == 10_000 and result["env_steps"] == 0
    assert result["deterministic"]["returns"] == result["returns"]
    assert not list((tmp_path / "run").rglob("*.safetensors"))
    other = run("control", tmp_path / "other", root, "reward=random", "eval.episodes=3", "seed=5")
    assert other["returns"] != result["returns"]  # Another seed is another stream of actions.
    monkeypatch.setattr(GymVectorEnv, "_step", None)
    run("control", tmp_path / "run", root, "reward=random", "eval.episodes=3")


def test_the_held_action_is_the_best_one_in_other_episodes_than_it_is_scored_in(root, tmp_path):
    result = run("control", tmp_path / "run", root, "reward=held_action", "eval.episodes=20")
    scores = []
    for action in (0, 1):
        env, lengths = gymnasium.make("CartPole-v1"), []
        for start in starts(seed=0, episodes=20):
            env.reset()
            env.unwrapped.state, length, ended = start, 0, False
            while not ended:
                _, _, ended, _, _ = env.step(action)
                length += 1
            lengths.append(length)
        scores.append(sum(lengths) / 20)
    logged = [row["held_action/return_mean"] for row in rows(tmp_path / "run")]
    assert logged == scores and scores[0] != scores[1]
    assert result["held_action"] == scores.index(max(scores))
    assert result["seeds"]["evaluation"] == 10_000
    # Another seed chooses in other episodes; those that are scored are the same for all.
    other = run("control", tmp_path / "o", root, "reward=held_action", "eval.episodes=20", "seed=1")
    if other["held_action"] == result["held_action"]:
        assert other["returns"] == result["returns"]
    assert [row["held_action/return_mean"] for row in rows(tmp_path / "o")] != logged
    assert not list((tmp_path / "run").rglob("*.safetensors"))


def test_a_continuous_action_cannot_be_held(tmp_path, capsys):
    words = ["task.env_id=Pendulum-v1", "reward=held_action", f"out={tmp_path / 'run'}"]
    assert main(["run", "control", *words]) == 2
    assert "reward=held_action needs discrete actions" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_result_with_another_action_is_refused(root, tmp_path, capsys):
    run("control", tmp_path / "run", root, "reward=held_action")
    place = tmp_path / "run" / "result.json"
    result = json.loads(place.read_text())
    for action in (2, -1, 0.5, None, True, "0"):
        place.write_text(json.dumps({**result, "held_action": action}))
        assert main(["eval", str(tmp_path / "run")]) == 2, action
        assert "action" in capsys.readouterr().err, action


@pytest.mark.parametrize(
    ("control", "recipe"), [pytest.param("giril", "giril", marks=pytest.mark.slow), ("icm", "cdil")]
)
def test_an_untrained_model_is_the_recipe_without_its_fit(control, recipe, root, tmp_path):
    run("control", tmp_path / "control", root, f"reward=untrained_{control}")
    run(recipe, tmp_path / "recipe", root, "fit.steps=0")
    assert weights(tmp_path / "control") == weights(tmp_path / "recipe")


@pytest.mark.slow
def test_negated_and_centred_are_made_of_the_recipe_s_own_reward(root, tmp_path):
    plain = ["scaling.enabled=false", "profile=paper"]
    run("giril", tmp_path / "giril", root, *plain)
    for reward in ("negated_giril", "centred_giril", "noise"):
        run("control", tmp_path / reward, root, *plain, f"reward={reward}")
        fits = [load_state(tmp_path / name / "fit.safetensors") for name in ("giril", reward)]
        for name, value in fits[0]["fit"]["loss"].items():
            assert value.equal(fits[1]["fit"]["loss"][name]), name
    paid = first_batch(tmp_path / "giril")
    assert first_batch(tmp_path / "negated_giril") == pytest.approx(-paid, rel=1e-5)
    rows = read_metrics(tmp_path / "centred_giril" / "metrics.jsonl")
    (mean,) = [row["moments/mean"] for row in rows if row["phase"] == "moments"]
    assert first_batch(tmp_path / "centred_giril") == pytest.approx(paid - mean, rel=1e-4)
    # 128 draws: a relative standard error of deviation / mean / sqrt(128).
    assert first_batch(tmp_path / "noise") == pytest.approx(mean, rel=0.5)


def test_a_constant_is_the_same_in_both_profiles(root, tmp_path):
    for profile in ("released", "paper"):
        run("control", tmp_path / profile, root, f"profile={profile}")
    assert weights(tmp_path / "released") == weights(tmp_path / "paper")


def test_noise_is_averaged_over_environments_in_the_released_profile(root, tmp_path):
    for profile in ("released", "paper"):
        run("control", tmp_path / profile, root, "reward=noise", f"profile={profile}")
    assert weights(tmp_path / "released") != weights(tmp_path / "paper")


@pytest.mark.slow
@pytest.mark.parametrize("words", [["control", "reward=noise"], ["cdil"]], ids=lambda w: w[0])
def test_a_run_that_died_ends_as_an_undisturbed_one(words, root, tmp_path, monkeypatch, capsys):
    recipe, *more = words
    run(recipe, tmp_path / "whole", root, *more)
    save = Run.save

    def save_and_die(self, name, state):
        save(self, name, state)
        if name == "ppo" and state["steps"] < 256:
            raise RuntimeError("the power went")

    with monkeypatch.context() as patch:
        patch.setattr(Run, "save", save_and_die)
        run(recipe, tmp_path / "run", root, *more, code=1)
    assert "the power went" in capsys.readouterr().err
    assert load_state(tmp_path / "run" / "ppo.safetensors")["steps"] == 128
    run(recipe, tmp_path / "run", root, *more)
    assert weights(tmp_path / "run") == weights(tmp_path / "whole")
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["control", "reward=bogus"],
            "reward=bogus must be 'constant', 'untrained_giril', 'untrained_icm', 'copy', 'noise', "
            "'negated_giril', 'centred_giril', 'entropy_bonus', 'random' or 'held_action'.",
        ),
        (["control", "giril.beta=0"], "giril.beta=0.0 must be greater than 0."),
        (
            ["cdil", "reward.features=all"],
            "reward.features=all must be 'inverse', 'both' or 'none'.",
        ),
        (["cdil", "reward.scale=0"], "reward.scale=0.0 must be greater than 0."),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_refusals(words, sentence, capsys, tmp_path):
    assert main(["run", *words, f"out={tmp_path / 'run'}"]) == 2
    assert capsys.readouterr().err == f"giril: {sentence}\n"
    assert not (tmp_path / "run").exists()
