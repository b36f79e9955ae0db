"""The recipe drex, with either learner; little is learned."""

import json
from unittest.mock import patch

import pytest
from short_runs import Killed, rows, weights

from giril_rl.cli.command_line import main
from giril_rl.config.compose import resolved
from giril_rl.config.recipes import config_class, find
from giril_rl.envs import GymVectorEnv
from giril_rl.runs.checkpoint import load_state
from giril_rl.runs.run import Run

SHORT = [
    *("steps=256", "eval.episodes=1", "logger=null", "expert.steps=2000", "demo.length=100"),
    *("clone.steps=40", "clone.log_every=20", "clone.hidden=[8]", "ranking.levels=3"),
    *("ranking.episodes=2", "fit.steps=20", "fit.log_every=10", "fit.batch=8"),
    *("reward.hidden=[8]", "reward.pairs=50", "reward.snippet=6", "task.env_id=CartPole-v1"),
]
LEARNERS = {
    "ppo": [
        *("ppo.num_envs=2", "ppo.rollout=64", "ppo.minibatch=64", "ppo.epochs=1"),
        *("ppo.hidden=[16,16]", "ppo.checkpoint_every=128"),
    ],
    "sac": [
        *("sac.num_envs=2", "sac.rollout=8", "sac.batch=16", "sac.hidden=[16]"),
        *("sac.random_steps=64", "sac.checkpoint_every=128", "sac.log_every=64"),
    ],
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Where this file's runs share one expert and one demonstration."""
    return tmp_path_factory.mktemp("runs")


def words(out, root, *more, algorithm="sac"):
    place = [f"out={out}", f"root={root}", f"algorithm={algorithm}"]
    known = [*SHORT, *LEARNERS[algorithm], *place, *more]
    return ["run", "drex", *{word.split("=")[0]: word for word in known}.values()]


def result(folder):
    return json.loads((folder / "result.json").read_text())


def interrupted(folder, root, phase, step, algorithm="sac"):
    """Begins a run that is killed at a row of its log."""
    log, until = Run.log, phase

    def killed(self, at, values, *, phase):
        log(self, at, values, phase=phase)
        if phase == until and at >= step:
            raise Killed

    with patch.object(Run, "log", killed):
        assert main(words(folder, root, algorithm=algorithm)) == 1


@pytest.fixture(scope="module", params=[pytest.param("ppo", marks=pytest.mark.slow), "sac"])
def whole(request, root, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert main(words(folder, root, algorithm=request.param)) == 0
    return request.param, folder


def test_from_command_to_result(whole):
    algorithm, folder = whole
    found = result(folder)
    assert found["method"] == "drex" and found["env_steps"] == 256 and found["fit_seconds"] > 0
    ranking = found["ranking"]
    assert ranking["noise"] == [0, 1 / 3, 2 / 3]
    kept = load_state(folder / "ranking.safetensors")
    assert ranking["steps"] == len(kept["observation"]) == int(kept["lengths"].sum())
    logged = [row for row in rows(folder) if row["phase"] == "ranking"]
    assert [row["ranking/return_mean"] for row in logged] == ranking["return_means"]
    phases = {row["phase"] for row in rows(folder)}
    assert phases == {"clone", "ranking", "fit", algorithm}
    assert (folder / "curve.png").exists()  # A learning curve, not the clone's losses.


@pytest.mark.parametrize(
    ("phase", "step"),
    [
        pytest.param("clone", 20, marks=pytest.mark.slow),
        pytest.param("ranking", 1, marks=pytest.mark.slow),
        pytest.param("fit", 10, marks=pytest.mark.slow),
        (None, 100),
    ],
)
def test_resumed_bit_for_bit(phase, step, whole, root, tmp_path):
    algorithm, folder = whole
    interrupted(tmp_path / "run", root, phase or algorithm, step, algorithm)
    assert main(words(tmp_path / "run", root, algorithm=algorithm)) == 0
    assert weights(tmp_path / "run") == weights(folder)
    assert rows(tmp_path / "run") == rows(folder)
    assert result(tmp_path / "run")["ranking"] == result(folder)["ranking"]


def test_the_true_reward_is_never_learned_from(whole, root, tmp_path):
    algorithm, folder = whole
    step = GymVectorEnv._step

    def garbage(self, tensordict):
        out = step(self, tensordict)
        return out.set("reward", out["reward"] * 1e3)

    demo = next(root.glob("demos/*/*/card.json")).parent
    again = words(tmp_path / "run", root, f"demo.path={demo}", algorithm=algorithm)
    with patch.object(GymVectorEnv, "_step", garbage):
        assert main(again) == 0
    assert weights(tmp_path / "run") == weights(folder)
    expected = [1e3 * value for value in result(folder)["ranking"]["return_means"]]
    assert result(tmp_path / "run")["ranking"]["return_means"] == pytest.approx(expected)


def test_held_out_transitions_stop_the_clone(root, tmp_path):
    more = ["clone.stop=held_out", "demo.subsample=2", "steps=64"]
    assert main(words(tmp_path / "run", root, *more)) == 0


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["clone.stop=held_out"], "clone.stop=held_out needs transitions to hold out"),
        (["task=breakout"], "D-REX keeps whole episodes of vectors and this task shows images"),
        (["reward.margin=0.99"], "reward.margin=0.99 is more than any two of the noise levels"),
    ],
)
def test_settings_that_do_not_fit_are_refused(more, sentence, tmp_path, capsys):
    assert main(["run", "drex", f"out={tmp_path / 'run'}", *more]) != 0
    assert sentence in capsys.readouterr().err


def test_the_default_is_off_policy_from_the_whole_demonstration():
    found = find("drex")
    config, _ = resolved(found, config_class(found), [])
    assert (config.algorithm, config.demo.subsample) == ("sac", 1)
