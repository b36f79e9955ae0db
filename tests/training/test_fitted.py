"""What a run's folder gives back: its reward and its demonstration, or a sentence."""

import json
import shutil
from dataclasses import asdict

import pytest
import torch
import yaml
from tensordict import TensorDict

from giril_rl.compose import resolved
from giril_rl.demos import Demonstration
from giril_rl.envs import make_env
from giril_rl.errors import UserError
from giril_rl.recipe_config import config_class
from giril_rl.recipes import find
from giril_rl.rewards import GenerativeRewardLoss
from giril_rl.training import expert, fitted, generative_reward
from giril_rl.training.checkpoint import save_state
from giril_rl.training.fitted import find_demonstration, load_reward

pytest.importorskip("ale_py")
KEY = ("next", "intrinsic_reward")


@pytest.fixture
def made(tmp_path):
    """``made(method, *words)``: a finished run's folder and the model that it was left by."""

    def write(method, *words, weights=True):
        recipe, _, kind = method.partition(":")
        words = ("task=breakout", f"root={tmp_path}", "seed=3", *words)
        words += (f"reward={kind}",) if kind else ()
        found = find(recipe)
        cfg = resolved(found, config_class(found), words)[0]
        folder = tmp_path / recipe / "breakout" / "default" / "seed3"
        folder.mkdir(parents=True)
        (folder / "config.yaml").write_text(yaml.safe_dump({"recipe": recipe, **asdict(cfg)}))
        (folder / "result.json").write_text(json.dumps({"method": method, "demo_transitions": 6}))
        env = make_env(cfg.task, 1, seed=0)
        section = cfg.giril if kind else cfg.reward
        model = generative_reward(section, env, None, seed=3 if section.seed is None else 9)
        if weights:
            with torch.no_grad():
                model.decoder.last.bias += 0.25
            loss = GenerativeRewardLoss(model)
            save_state(folder / "fit.safetensors", {"step": 1, "loss": dict(loss.state_dict())})
        return folder, model.eval(), cfg

    return write


def transitions(length=6):
    generator = torch.Generator().manual_seed(0)
    frames = torch.randint(0, 256, (length + 1, 1, 84, 84), generator=generator)
    stacks = frames.to(torch.uint8).expand(-1, 4, -1, -1)
    flags = {key: torch.zeros(length, 1, dtype=torch.bool) for key in ("terminated", "truncated")}
    after = {"observation": stacks[1:], "reward": torch.zeros(length, 1), **flags}
    flags["terminated"][-1] = True
    after["done"] = flags["terminated"].clone()
    return TensorDict(
        {
            "observation": stacks[:-1],
            "action": torch.arange(length) % 4,
            "episode": torch.zeros(length, dtype=torch.int64),
            "step": torch.arange(length),
            "next": TensorDict(after, [length]),
        },
        [length],
    )


@torch.no_grad()
def values(reward):
    return reward(transitions().select(*reward.in_keys))[KEY]


@pytest.mark.parametrize("beta", [1.0, 0.9])
def test_the_reward_is_the_one_that_was_fitted(made, beta):
    folder, left, _ = made("giril", f"reward.beta={beta}")
    model, reward = load_reward(folder)
    assert reward is model and not model.training
    assert torch.equal(values(reward), values(left))


def test_controls_are_made_of_the_model(made, tmp_path):
    folder, left, _ = made("control:negated_giril")
    assert torch.equal(values(load_reward(folder)[1]), -values(left))
    shutil.rmtree(tmp_path / "control")
    folder, left, _ = made("control:centred_giril")
    with pytest.raises(UserError, match="lacks moments/mean"):
        load_reward(folder)
    (folder / "metrics.jsonl").write_text('{"phase": "moments", "step": 0, "moments/mean": 100.5}')
    assert torch.equal(values(load_reward(folder)[1]), values(left) - 100.5)


@pytest.mark.parametrize(
    ("method", "word"), [("control:untrained_giril", "giril.seed=9"), ("giril", "fit.steps=0")]
)
def test_what_was_not_fitted_comes_from_its_seed(made, method, word):
    folder, left, _ = made(method, word, weights=False)
    assert torch.equal(values(load_reward(folder)[1]), values(left))


def test_what_cannot_be_loaded_is_refused_in_a_sentence(made):
    folder, _, _ = made("giril")
    path = folder / "fit.safetensors"
    save_state(path, {"loss": {"reward.decoder.last.bias": torch.zeros(3)}})
    with pytest.raises(UserError, match="belongs to another run"):
        load_reward(folder)
    path.write_bytes(b"1")
    with pytest.raises(UserError, match="is damaged"):
        load_reward(folder)
    path.unlink()
    with pytest.raises(UserError, match="does not exist"):
        load_reward(folder)
    (folder / "result.json").write_text('{"method": "gail"}')
    with pytest.raises(UserError, match="has no generative reward: its method is gail"):
        load_reward(folder)


def test_the_demonstration_is_found_and_never_made(made, tmp_path, monkeypatch):
    folder, _, cfg = made("giril")
    made_by = "0123456789ab"
    monkeypatch.setattr(fitted, "config_hash", lambda _: made_by)
    assert find_demonstration(folder) is None
    assert {path.name for path in tmp_path.iterdir()} == {"giril"}
    place = tmp_path / expert.demonstration_place(cfg.task, cfg.demo, made_by)
    Demonstration(transitions()).save(place)
    found = find_demonstration(folder)
    assert torch.equal(found.transitions["observation"], transitions()["observation"])
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("giril", "demos"):
        (tmp_path / name).rename(moved / name)
    folder = moved / folder.relative_to(tmp_path)
    assert len(find_demonstration(folder)) == 6
    (folder / "result.json").write_text('{"method": "giril", "demo_transitions": 7}')
    assert find_demonstration(folder) is None  # Another one lies there by now.


def test_a_demonstration_or_an_expert_may_be_given_by_its_path(made, tmp_path):
    folder, _, _ = made("giril", f"demo.path={tmp_path}/given")
    assert find_demonstration(folder) is None
    Demonstration(transitions()).save(tmp_path / "given")
    assert len(find_demonstration(folder)) == 6
    shutil.rmtree(tmp_path / "giril")
    folder, _, cfg = made("giril", f"expert.path={tmp_path}/expert")
    place = tmp_path / expert.demonstration_place(cfg.task, cfg.demo, "ba9876543210")
    (tmp_path / "given").rename(tmp_path / "moved")
    Demonstration.load(tmp_path / "moved").save(place)
    assert find_demonstration(folder) is None
    (tmp_path / "expert").mkdir()
    (tmp_path / "expert" / "result.json").write_text('{"config_hash": "ba9876543210"}')
    assert len(find_demonstration(folder)) == 6
