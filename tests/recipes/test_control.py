"""Every control from its command to its result, with settings so small that nothing is learned."""

import json
import math

import pytest

from giril_rl.cli import main
from giril_rl.envs import GymVectorEnv
from giril_rl.training.checkpoint import load_state
from giril_rl.training.metrics import read_metrics
from giril_rl.training.run import Run

REWARDS = [
    *("constant", "untrained_giril", "untrained_icm", "copy", "noise", "negated_giril"),
    *("centred_giril", "random"),
]
TINY = [
    *("steps=256", "ppo.num_envs=2", "ppo.rollout=64", "ppo.minibatch=64", "ppo.epochs=1"),
    *("ppo.hidden=[16,16]", "ppo.checkpoint_every=128", "eval.episodes=2", "logger=null"),
    *("expert.steps=2000", "demo.length=100", "demo.subsample=2", "fit.steps=20"),
    *("fit.log_every=10", "task.env_id=CartPole-v1"),
]

RESULT = {
    *("method", "task", "profile", "seed", "seeds", "env_steps", "return_mean", "return_std"),
    *("return_median", "episode_length_mean", "episodes", "returns", "deterministic"),
    *("wall_seconds", "steps_per_second", "expert_return_mean", "demo_return_mean"),
    *("demo_transitions", "config_hash", "versions", "finished_at"),
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Where this file's runs share one expert and one demonstration."""
    return tmp_path_factory.mktemp("runs")


def run(recipe, out, root, *more, code=0):
    by_key = {word.split("=")[0]: word for word in [*TINY, *more]}
    assert main(["run", recipe, f"out={out}", f"root={root}", *by_key.values()]) == code
    return json.loads((out / "result.json").read_text()) if code == 0 else None


def weights(folder):
    state = load_state(folder / "policy/model.safetensors")
    return {name: value.tolist() for name, value in state.items()}


def rows(folder):
    """Metrics less what a clock says, in their order."""
    found = read_metrics(folder / "metrics.jsonl")
    return [{k: v for k, v in row.items() if "seconds" not in k} for row in found]


def first_batch(folder):
    """The mean reward of the first batch, which an untrained policy played."""
    rows = [row for row in read_metrics(folder / "metrics.jsonl") if row["phase"] == "ppo"]
    return rows[0]["ppo/reward_mean"]


@pytest.mark.parametrize("reward", REWARDS)
def test_each_control_leaves_a_whole_result(reward, root, tmp_path):
    result = run("control", tmp_path / "run", root, f"reward={reward}")
    assert result.keys() >= RESULT
    assert result["method"] == f"control:{reward}"
    assert result["env_steps"] == (0 if reward == "random" else 256)
    needs_demo = reward not in ("constant", "random")
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


@pytest.mark.parametrize("reward", ["constant", "random"])
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


@pytest.mark.parametrize(("control", "recipe"), [("giril", "giril"), ("icm", "cdil")])
def test_an_untrained_model_is_the_recipe_without_its_fit(control, recipe, root, tmp_path):
    run("control", tmp_path / "control", root, f"reward=untrained_{control}")
    run(recipe, tmp_path / "recipe", root, "fit.steps=0")
    assert weights(tmp_path / "control") == weights(tmp_path / "recipe")


def test_negated_and_centred_are_made_of_the_recipe_s_own_reward(root, tmp_path):
    plain = ["scaling.enabled=false", "profile=paper"]
    run("giril", tmp_path / "giril", root, *plain)
    for reward in ("negated_giril", "centred_giril", "noise"):
        run("control", tmp_path / reward, root, *plain, f"reward={reward}")
        fits = [load_state(tmp_path / name / "fit.safetensors") for name in ("giril", reward)]
        for name, value in fits[0]["loss"].items():
            assert value.equal(fits[1]["loss"][name]), name
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
            "reward=bogus: choose one of constant, untrained_giril, untrained_icm, copy, noise, "
            "negated_giril, centred_giril, random.",
        ),
        (["control", "giril.beta=0"], "giril.beta=0.0 must be in (0, 1]."),
        (
            ["cdil", "reward.features=all"],
            "reward.features=all: choose one of inverse, both, none.",
        ),
        (["cdil", "reward.scale=0"], "reward.scale=0.0 must be above 0."),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_refusals(words, sentence, capsys, tmp_path):
    assert main(["run", *words, f"out={tmp_path / 'run'}"]) == 2
    assert capsys.readouterr().err == f"giril: {sentence}\n"
    assert not (tmp_path / "run").exists()
