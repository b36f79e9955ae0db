"""What a run's folder gives back of its demonstration."""

import json
import os
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
import yaml
from tensordict import TensorDict

from giril_rl.config.compose import resolved
from giril_rl.config.recipes import config_class, find
from giril_rl.demos import Demonstration, shipped_demonstrations
from giril_rl.errors import UserError
from giril_rl.runs.identity import config_hash
from giril_rl.training import demonstrations, experts
from giril_rl.training.demonstrations import find_demonstration

pytest.importorskip("ale_py")
KEY = ("next", "intrinsic_reward")
RESULT = {"method": "giril", "task": "breakout", "seed": 3, "env_steps": 1, "episodes": 1}
RESULT |= {"return_mean": 0.0, "return_std": 0.0, "return_median": 0.0}
RESULT |= {"episode_length_mean": 1.0, "config_hash": "ba9876543210", "demo_transitions": 6}


@pytest.fixture
def made(tmp_path):
    """``made(recipe, *words)``: a finished run's folder and its settings."""

    def write(recipe, *words):
        if not any(word.startswith("demo.path=") for word in words):
            words = ("demo.path=null", *words)
        words = ("task=breakout", f"root={tmp_path}", "seed=3", *words)
        found = find(recipe)
        cfg = resolved(found, config_class(found), words)[0]
        folder = tmp_path / recipe / "breakout" / "default" / "seed3"
        folder.mkdir(parents=True)
        (folder / "config.yaml").write_text(yaml.safe_dump({"recipe": recipe, **asdict(cfg)}))
        (folder / "result.json").write_text(json.dumps({**RESULT, "method": recipe}))
        return folder, cfg

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


def test_the_demonstration_is_found_and_never_made(made, tmp_path, monkeypatch):
    folder, cfg = made("giril")
    made_by = "0123456789ab"
    monkeypatch.setattr(demonstrations, "config_hash", lambda _: made_by)
    assert find_demonstration(folder, tmp_path) is None
    assert {path.name for path in tmp_path.iterdir()} == {"giril"}
    place = tmp_path / demonstrations.demonstration_place(cfg, cfg.demo, made_by)
    Demonstration(transitions()).save(place)
    found = find_demonstration(folder, tmp_path)
    assert torch.equal(found.transitions["observation"], transitions()["observation"])
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("giril", "demos"):
        (tmp_path / name).rename(moved / name)
    folder = moved / folder.relative_to(tmp_path)
    assert len(find_demonstration(folder, tmp_path)) == 6
    assert len(find_demonstration(folder, moved)) == 6
    assert find_demonstration(folder, moved / "giril") is None  # Beside what is reported on.
    (folder / "result.json").write_text(json.dumps({**RESULT, "demo_transitions": 7}))
    assert find_demonstration(folder, tmp_path) is None  # Another one lies there by now.


def test_a_demonstration_or_an_expert_may_be_given_by_its_path(made, tmp_path):
    folder, _ = made("giril", f"demo.path={tmp_path}/given")
    assert find_demonstration(folder, tmp_path) is None
    Demonstration(transitions()).save(tmp_path / "given")
    assert len(find_demonstration(folder, tmp_path)) == 6
    shutil.rmtree(tmp_path / "giril")
    folder, cfg = made("giril", f"expert.path={tmp_path}/expert")
    place = tmp_path / demonstrations.demonstration_place(cfg, cfg.demo, "ba9876543210")
    (tmp_path / "given").rename(tmp_path / "moved")
    Demonstration.load(tmp_path / "moved").save(place)
    assert find_demonstration(folder, tmp_path) is None
    (tmp_path / "expert").mkdir()
    (tmp_path / "expert" / "result.json").write_text(json.dumps(RESULT))
    assert len(find_demonstration(folder, tmp_path)) == 6


@pytest.mark.parametrize("current", [".", "study", "study/giril", "/"])
def test_a_relative_root_is_found_from_any_current_directory(made, tmp_path, monkeypatch, current):
    folder, cfg = made("giril")
    set_to(folder, "root", "study/mine")
    made_by = config_hash(experts.expert_settings(cfg, cfg.expert))
    place = demonstrations.demonstration_place(cfg, cfg.demo, made_by)
    Demonstration(transitions()).save(tmp_path / "study/mine" / place)
    (tmp_path / "giril").rename(tmp_path / "study/giril")
    folder = tmp_path / "study" / folder.relative_to(tmp_path)
    monkeypatch.chdir(tmp_path / current)
    assert len(find_demonstration(folder, tmp_path)) == 6
    (tmp_path / "study/mine/demos").rename(tmp_path / "study/demos")
    assert len(find_demonstration(folder, tmp_path / "study")) == 6
    within = Path(os.path.relpath(tmp_path / "study"))
    assert len(find_demonstration(within / folder.relative_to(tmp_path / "study"), within)) == 6


@pytest.mark.parametrize("key", ["demo.path", "expert.path", "root"])
@pytest.mark.parametrize("kind", ["absolute", "up", "link"])
def test_nothing_outside_the_folder_is_read(made, tmp_path, monkeypatch, key, kind):
    folder, cfg = made("giril")
    within, outside = tmp_path / "giril", tmp_path / "outside"
    made_by = config_hash(experts.expert_settings(cfg, cfg.expert))
    demo = outside
    if key == "expert.path":
        outside.mkdir()
        (outside / "result.json").write_text(json.dumps(RESULT))
        demo = within / demonstrations.demonstration_place(cfg, cfg.demo, RESULT["config_hash"])
    elif key == "root":
        demo = outside / demonstrations.demonstration_place(cfg, cfg.demo, made_by)
    Demonstration(transitions()).save(demo)
    (within / "link").symlink_to(outside)
    value = {"absolute": str(outside), "up": "../outside", "link": "link"}[kind]
    set_to(folder, key, value)
    monkeypatch.chdir(within)
    assert find_demonstration(folder, within) is None
    if key == "expert.path":  # Which is what would have been found.
        set_to(folder, key, str(outside))
        assert len(find_demonstration(folder, tmp_path)) == 6


@pytest.mark.parametrize("key", ["demo.path", "expert.path", "root"])
def test_a_place_that_is_none_is_refused_or_not_there(made, key):
    folder, _ = made("giril")
    for value in (5, ["x"], {"a": 1}, True):
        set_to(folder, key, value)
        with pytest.raises(UserError, match=rf"config\.yaml: {key}=.* is needed\.$"):
            find_demonstration(folder, folder)
    for value in ("\0", "x" * 5000, "/dev/zero", "~", ""):
        set_to(folder, key, value)
        assert find_demonstration(folder, folder) is None


def set_to(folder, key, value):
    config = yaml.safe_load((folder / "config.yaml").read_text())
    part, _, name = key.rpartition(".")
    (config[part] if part else config)[name] = value
    (folder / "config.yaml").write_text(yaml.safe_dump(config))


def test_the_packages_own_demonstration_is_found(made, tmp_path):
    folder, _ = made("giril", "demo.path=shipped")
    shipped = Demonstration.load(shipped_demonstrations()["breakout"][0])
    assert find_demonstration(folder, tmp_path) is None  # Of six transitions there is none.
    result = {**RESULT, "demo_transitions": len(shipped)}
    (folder / "result.json").write_text(json.dumps(result))
    found = find_demonstration(folder, tmp_path)
    assert (found.transitions == shipped.transitions).all()
