"""Environments of the user's own, on the command line: found where they are, imported if named."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from giril_rl.cli.command_line import main
from giril_rl.config.compose import resolved
from giril_rl.config.imports import import_modules
from giril_rl.config.recipes import config_class
from giril_rl.experiments.study.plan import Planner
from giril_rl.experiments.study.spec import read_spec

MODULE = """
import gymnasium
import numpy as np


class Own(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-9, 9, (2,))
    action_space = gymnasium.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.full(2, self.steps, np.float32), 1.0, self.steps == 5, False, {}


gymnasium.register("Own-v0", entry_point=Own, max_episode_steps=20)
"""
TINY = ["ppo.num_envs=2", "ppo.rollout=8", "ppo.minibatch=8", "ppo.epochs=1", "ppo.hidden=[4]"]
TINY += ["steps=16", "eval.episodes=2", "logger=null"]


@pytest.fixture
def own(tmp_path, monkeypatch):
    """An empty folder but for ``own_envs.py``; `own()` takes its import back."""
    import gymnasium

    def forget():
        sys.modules.pop("own_envs", None)
        gymnasium.registry.pop("Own-v0", None)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    Path("own_envs.py").write_text(MODULE)
    yield forget
    forget()


def test_a_run_on_it_is_made_and_scored(own, refused):
    words = ["run", "control", "task.env_id=own_envs:Own-v0", *TINY]
    assert main(words) == 0
    run = "runs/control/own_envs-Own-v0/"
    (result,) = Path(run).glob("*/seed0/result.json")
    assert json.loads(result.read_text())["episode_length_mean"] == 5
    folder = str(result.parent)
    assert main(["eval", folder]) == 0  # The module is imported already.
    own()
    assert refused("eval", folder) == (
        f"{folder} names the module own_envs, and reading a run imports nothing: if you trust it, "
        "add --import own_envs."
    )
    assert "own_envs" not in sys.modules
    assert main(["eval", folder, "--import", "own_envs"]) == 0


def test_modules_may_be_named_apart_and_change_no_name(own):
    assert main(["run", "control", "imports=[own_envs]", "task.env_id=Own-v0", *TINY]) == 0
    (result,) = Path("runs/control/Own-v0").glob("*/seed0/result.json")
    assert "imports" not in result.parent.parent.name
    own()
    assert main(["eval", str(result.parent), "--import", "own_envs", "--episodes", "2"]) == 0


def test_a_copied_recipe_finds_what_lies_beside_it(own, tmp_path, monkeypatch):
    assert main(["cp", "control", "mine.py"]) == 0
    Path("mine.py").write_text(Path("mine.py").read_text() + "\nimport own_envs\n")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    assert main(["run", "../mine.py", "task.env_id=Own-v0", "out=o", *TINY]) == 0


@pytest.mark.parametrize(
    "words", [["--env-id", "own_envs:Own-v0"], ["--env-id", "Own-v0", "--import", "own_envs"]]
)
def test_its_demonstrations_are_imported(own, words):
    observations = np.repeat(np.arange(6, dtype=np.float32)[:, None], 2, axis=1)
    actions = np.zeros((5, 1), np.float32)
    np.savez("own.npz", observations=observations, actions=actions, lengths=[5], terminated=[True])
    assert main(["demo", "import", "own.npz", "--out", "demo", *words]) == 0
    assert json.loads(Path("demo/card.json").read_text())["env_id"] == words[1]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (None, "there is no module own_envs among the installed packages or in HERE: install it, "),
        ("import no_such", "own_envs imports no_such, and there is no such module among the insta"),
        ("1 / 0", "the module own_envs cannot be imported (HERE/own_envs.py, line 1: ZeroDivision"),
        ("x = (", "the module own_envs cannot be imported ("),
        ("", "task.env_id=own_envs:Own-v0 is not a Gymnasium id that own_envs registers: check it"),
    ],
)
def test_a_module_that_cannot_be_used_is_named(own, text, sentence, tmp_path, monkeypatch, refused):
    monkeypatch.setattr("gymnasium.registry", {})  # Other tests may have added what is near.
    Path("own_envs.py").unlink()
    shutil.rmtree("__pycache__", ignore_errors=True)
    if text is not None:
        Path("own_envs.py").write_text(text)
    found = refused("run", "control", "task.env_id=own_envs:Own-v0", *TINY)
    assert found.startswith(sentence.replace("HERE", str(tmp_path)))
    assert not Path("runs").exists()


def test_an_installed_package_goes_before_a_file_of_its_name(own, tmp_path):
    Path("wave.py").write_text("raise SystemExit('taken for the library')")
    sys.modules.pop("wave", None)
    import_modules(["wave"], tmp_path)
    assert Path(sys.modules["wave"].__file__).parent != tmp_path


def test_a_study_names_modules_on_its_command_line(own, refused):
    Path("mine.yaml").write_text(
        "groups: [{label: a, recipe: control, task.env_id: 'own_envs:Own-v0'}]"
    )
    assert refused("study", "mine.yaml", "--dry-run") == (
        "mine names the module own_envs, and a study's file alone imports nothing: if you trust "
        "it, add imports=[own_envs] to the command."
    )
    (run,) = Planner(Path("runs")).plan(read_spec(Path("mine.yaml")), ["imports=[own_envs]"])
    config, _ = resolved(run.recipe, config_class(run.recipe), run.words)
    assert (config.imports, config.task.env_id) == (["own_envs"], "own_envs:Own-v0")
    assert "own_envs" not in sys.modules  # Its run imports it, in a process of its own.
    Path("own_envs.py").unlink()
    sentence = refused("study", "mine.yaml", "imports=[own_envs]", "--dry-run")
    assert sentence.startswith("there is no module own_envs among the installed packages or in ")
