"""The scripts under docs/tutorials at tiny budgets: that they run, and that what they say holds."""

import ast
import importlib.util
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from giril_rl import IntrinsicReward
from giril_rl.envs import make_env

FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"


def load(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def paid(reward, batch):
    return IntrinsicReward(reward)(batch.clone())["next", "reward"]


# ppo_with_giril.py

TINY = {"frames": 128, "batch": 64, "epochs": 1, "fit_steps": 5}


def test_ppo_trains_on_a_given_demonstration_or_its_own():
    tutorial = load("ppo_with_giril")
    history = tutorial.train(**TINY)
    assert len(history) == 2 and all(value < 0 for value in history)
    demo = TensorDict(
        {
            "observation": torch.randn(50, 3),
            "action": torch.rand(50, 1),
            "next": {"observation": torch.randn(50, 3)},
        },
        [50],
    )
    assert len(tutorial.train(demonstration=demo, **TINY)) == 2


def test_without_the_marked_lines_the_script_is_plain_torchrl():
    lines = (FOLDER / "ppo_with_giril.py").read_text().splitlines()
    marked = [line for line in lines if line.endswith("# GIRIL")]
    assert len(marked) <= 6
    rest = "\n".join(line for line in lines if line not in marked)
    code = ast.unparse([n for n in ast.parse(rest).body if not isinstance(n, ast.Expr)])
    for name in ("giril_rl", "reward.", "IntrinsicReward", "fit("):
        assert name not in code
    spec = importlib.util.spec_from_loader("plain", None)
    plain = importlib.util.module_from_spec(spec)
    exec(compile(rest, "plain", "exec"), plain.__dict__)
    assert len(plain.train(frames=64, batch=64, epochs=1)) == 1


# giril_on_your_environment.py


def test_the_ball_is_imported_fitted_and_trained_on(tmp_path):
    tutorial = load("giril_on_your_environment")
    scores = tutorial.main(steps=2048, fit_steps=20, episodes=5, folder=tmp_path)
    assert list(scores) == ["GIRIL", "constant reward", "random"]
    assert all(0 < one.return_mean <= one.episode_length_mean <= 200 for one in scores.values())
    trained = [tmp_path / name / "ppo.safetensors" for name in ("giril", "constant")]
    assert trained[0].read_bytes() != trained[1].read_bytes()


def test_the_fitted_reward_tells_the_demonstration_from_random_play(tmp_path):
    tutorial = load("giril_on_your_environment")
    tutorial.play(tmp_path / "ball.npz")
    demo = tutorial.import_demonstration(str(tmp_path / "ball.npz"), tutorial.TASK)
    assert demo.num_episodes == 5 and demo.lengths.tolist() == [200] * 5
    reward = tutorial.generative_reward(demo, 300)
    random = make_env(tutorial.TASK, 1, seed=0).rollout(200, break_when_any_done=False)
    ours, other = paid(reward, demo.transitions), paid(reward, random)
    assert ours.isfinite().all() and other.isfinite().all()
    assert other.mean() > 3 * ours.mean()  # It pays for what the model foresees badly.


# gail_from_minari.py


@pytest.fixture
def minari(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return pytest.importorskip("minari")


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_gail_learns_to_tell_the_policy_from_the_data_set(minari):
    tutorial = load("gail_from_minari")
    demo = tutorial.demonstration("pendulum/test-v0", "Pendulum-v1", episodes=2)
    assert minari.list_local_datasets().keys() == {"pendulum/test-v0"}
    assert demo.card["replay"] == "same bits" and demo.returns.min() > -600
    again = tutorial.demonstration("pendulum/test-v0", "Pendulum-v1", episodes=1)
    assert len(again) == 200

    logs = list(tutorial.train(demo, frames=1200, batch=400, epochs=1, updates=30))
    assert len(logs) == 3
    assert all(math.isfinite(value) for log in logs for value in log.values())
    last = logs[-1]
    assert min(last["accuracy on the expert"], last["accuracy on the policy"]) > 0.7
    assert last["reward"] < 0  # The logit of a policy that is told apart.


# reward_of_your_own.py


def test_a_reward_of_ones_own_prefers_the_demonstration_and_trains_a_policy(tmp_path, capsys):
    tutorial = load("reward_of_your_own")
    scores = tutorial.main(steps=2048, episodes=5, folder=tmp_path)
    lines = capsys.readouterr().out.splitlines()
    ours, random = (float(line.rpartition(" ")[2]) for line in lines if "reward of" in line)
    assert 2 * random < ours < 1
    assert all(one.return_mean > 1 for one in scores.values())
    trained = [tmp_path / name / "ppo.safetensors" for name in ("nearest", "constant")]
    assert trained[0].read_bytes() != trained[1].read_bytes()


def test_the_reward_is_40_lines_and_saved_with_its_states(tmp_path):
    tutorial = load("reward_of_your_own")
    text = (FOLDER / "reward_of_your_own.py").read_text()
    assert len(text.partition("# ... to here")[0].partition("class Nearest")[2].splitlines()) <= 40
    one, other = (tutorial.NearestState(torch.randn(5, 4)) for _ in range(2))
    batch = TensorDict({"next": {"observation": torch.randn(3, 2, 4)}}, [3, 2])
    assert not torch.equal(
        one(batch.clone())["next", "intrinsic_reward"],
        other(batch.clone())["next", "intrinsic_reward"],
    )
    other.load_state_dict(one.state_dict())
    assert torch.equal(
        one(batch.clone())["next", "intrinsic_reward"],
        other(batch.clone())["next", "intrinsic_reward"],
    )
