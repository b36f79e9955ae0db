"""Files that today's formats were written in are read, evaluated and reported for good."""

import zipfile
from pathlib import Path

import pytest
import torch
from files import DATA, kept, run_folder, words
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from giril_rl.cli.command_line import main
from giril_rl.demos import Demonstration
from giril_rl.errors import UserError
from giril_rl.files.disk import read_json, write_json
from giril_rl.files.untrusted import check_format
from giril_rl.policies import load_agent_from
from giril_rl.rewards import GenerativeReward
from giril_rl.runs.checkpoint import load_state

LOGITS = [0.6002023, -0.7985780, 0.0336854, -0.2988219]
PAID = [15336.5977, 15327.0957]


def test_they_are_small():
    assert sum(path.stat().st_size for path in DATA.rglob("*") if path.is_file()) < 200_000


def test_the_demonstrations_are_read(here):
    demo = Demonstration.load(DATA / "demonstration")
    assert (len(demo), demo.num_episodes, demo.returns.sum().item()) == (40, 1, 40.0)
    images = Demonstration.load(DATA / "demonstration_of_images").transitions
    assert images["observation"].shape == (4, 2, 6, 6)
    assert images["next", "observation"][:, 0, 0, 0].tolist() == [1, 2, 3, 4]


def test_reward_and_policy_are_read_and_do_what_they_did():
    reward = GenerativeReward.from_pretrained(DATA / "run/reward")
    batch = Demonstration.load(DATA / "demonstration").transitions
    paid = reward(batch.clone())["next", "intrinsic_reward"]
    assert paid.shape == (40, 1) and paid.isfinite().all() and paid.std() > 0
    policy = load_agent_from(DATA / "run/policy")
    card = read_json(DATA / "run/policy/card.json")
    assert (card["method"], card["task"], card["env_steps"]) == ("giril", "CartPole-v1", 256)
    assert policy.critic(torch.zeros(1, 4)).isfinite().all()


def test_a_policy_of_scaled_actions_does_what_it_did():
    policy = load_agent_from(DATA / "scaled_policy")
    assert read_json(DATA / "scaled_policy/card.json")["format_version"] == 2
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = policy.acting()(TensorDict({"observation": torch.tensor([1.0, -1.0])}, []))
    assert acted["action"].tolist() == [1750.0, -0.5]
    assert acted["drawn_action"].tolist() == [0.5, -4.0]


def test_those_of_pixels_do_what_they_did(tmp_path):
    zipfile.ZipFile(DATA / "pixels.zip").extractall(tmp_path)
    frames = (torch.arange(3 * 4 * 84 * 84).reshape(3, 4, 84, 84) % 251).to(torch.uint8)
    policy = load_agent_from(tmp_path / "policy")
    logits = policy.actor(frames[:1]).flatten()
    assert logits.tolist() == pytest.approx(LOGITS, rel=1e-3)
    reward = GenerativeReward.from_pretrained(tmp_path / "reward")
    batch = TensorDict({"observation": frames[:2], "action": torch.tensor([0, 3])}, [2])
    paid = reward(batch.set("next", {"observation": frames[1:]}))["next", "intrinsic_reward"]
    assert paid.flatten().tolist() == pytest.approx(PAID, rel=1e-5)


@pytest.mark.parametrize("name", ["fit", "ppo"])
def test_checkpoints_are_read(name):
    assert load_state(DATA / f"run/{name}.safetensors")["seconds"] > 0


def test_the_run_is_evaluated_and_reported(here, capsys):
    kept("run")
    result = read_json(Path("run/result.json"))
    assert main(["eval", "run", "--episodes", "1"]) == 0
    scores = read_json(Path("run/eval.json"))
    assert scores["deterministic"]["return_mean"] == result["deterministic"]["return_mean"]
    assert main(["report", ".", "--out", "report"]) == 0
    assert "1 finished runs" in capsys.readouterr().out
    assert "CartPole-v1" in Path("report/report.md").read_text()


@pytest.mark.slow
def test_the_run_goes_on_from_its_checkpoints(here):
    run_folder(finished=False)
    assert main(words()) == 0
    again, before = read_json(Path("run/result.json")), read_json(DATA / "run/result.json")
    assert again["config_hash"] == before["config_hash"]
    assert again["return_mean"] == pytest.approx(before["return_mean"])


def test_a_run_from_before_formats_were_numbered_is_read(here):
    kept("run_of_format_1")
    versions = read_json(Path("run_of_format_1/versions.json"))
    del versions["format_version"]
    write_json(Path("run_of_format_1/versions.json"), versions)
    assert main(["eval", "run_of_format_1", "--episodes", "1"]) == 0


def test_a_run_of_format_1_is_read_and_not_taken_for_todays(here, capsys):
    kept("demonstration")
    kept("run_of_format_1")
    assert main(["report", ".", "--out", "report"]) == 0
    assert "1 finished runs" in capsys.readouterr().out
    assert main(words("out=run_of_format_1")) == 2
    assert "has run format 1, and this giril_rl reads only 2" in capsys.readouterr().err


def test_the_numbers_written_are_those_that_are_promised():
    page = (DATA.parents[1] / "docs/stability.md").read_text()
    assert read_json(DATA / "run/versions.json")["format_version"] == 2
    assert read_json(DATA / "run_of_format_1/versions.json")["format_version"] == 1
    assert "| run folder | 2; 1 is read, not continued |" in page
    assert "| demonstration | 1 of vectors, 2 of images |" in page
    numbers = {"run/policy": 1, "scaled_policy": 2}
    for name, number in {"demonstration": 1, "demonstration_of_images": 2, **numbers}.items():
        assert read_json(DATA / name / "card.json")["format_version"] == number


@pytest.mark.parametrize("found", [0, None, "1", 1.0, True, [1], -1])
def test_what_is_no_number_of_a_format_is_refused_with_what_to_do(found):
    with pytest.raises(UserError, match=r"reads only 1: convert it\.$"):
        check_format(found, [1], where="a has format", older="convert it")
