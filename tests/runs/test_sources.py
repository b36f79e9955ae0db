"""A run that is there already goes on with the same code alone; its scores may be made anew."""

import json
import sys
from pathlib import Path

import pytest
import yaml
from short_runs import TINY

from giril_rl.cli.command_line import main
from giril_rl.experiments.study.plan import Planner
from giril_rl.experiments.study.spec import read_spec

RECIPE = '''"""Fake: a run without work."""

from dataclasses import asdict, dataclass

from giril_rl.config.schema import RunConfig, knob
from giril_rl.runs.identity import config_hash
from giril_rl.training import Run

SCORES = ("return_mean", "return_std", "return_median", "episode_length_mean")


@dataclass
class Config(RunConfig):
    stop: bool = knob(False, "stop before the end")


def main(cfg, out):
    with Run.open(out, {**asdict(cfg), "stop": False}, recipe="fake") as run:
        if run.finished:
            return
        if cfg.stop:
            raise KeyboardInterrupt
        about = {"method": "fake", "task": cfg.task.name, "seed": cfg.seed, "env_steps": 0}
        about |= {"episodes": cfg.eval.episodes, "config_hash": config_hash(cfg)}
        about |= dict.fromkeys(SCORES, 1.0)
        run.finish(about)
'''
SETTINGS = "defaults: [recipe_schema, {task: inverted_pendulum}, _self_]\nsteps: 2000\n"


@pytest.fixture
def fake(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    Path("fake.py").write_text(RECIPE)
    Path("fake.yaml").write_text(SETTINGS)
    return ["run", "fake.py", "out=o"]


def told(capsys, *words, code=0):
    capsys.readouterr()
    assert main(words) == code
    return capsys.readouterr().err


@pytest.mark.parametrize("stop", ["stop=true", "stop=false"])
def test_a_recipe_with_another_text_is_another_run(fake, stop, capsys):
    assert main([*fake, stop]) == (130 if stop == "stop=true" else 0)
    Path("fake.py").write_text(RECIPE.replace("1.0", "2.0"))
    assert told(capsys, *fake, code=2) == (
        "giril: o was made with an earlier text of the recipe: to begin anew choose another out=, "
        "or delete the folder.\n"
    )
    Path("fake.py").write_text(RECIPE)
    assert main(fake) == 0
    Path("fake.py").write_text(RECIPE.replace("1.0", "2.0"))
    assert main(["run", "fake.py", "out=new"]) == 0
    assert json.loads(Path("new/result.json").read_text())["return_mean"] == 2.0


def test_so_it_is_in_a_study(fake, capsys):
    Path("mine.yaml").write_text("groups: [{label: a, recipe: fake.py}]")
    assert main(fake[:2]) == 0
    Path("fake.py").write_text(RECIPE.replace("1.0", "2.0"))
    error = told(capsys, "study", "mine.yaml", "--dry-run", code=2)
    assert "was made with an earlier text of the recipe" in error


def test_a_module_of_ones_own_with_another_text_is_another_run(fake, capsys):
    Path("own_part.py").write_text("x = 1\n")
    assert main([*fake, "imports=[own_part]"]) == 0
    Path("own_part.py").write_text("x = 2\n")
    error = told(capsys, *fake, "imports=[own_part]", code=2)
    assert "o was made with an earlier text of the module own_part" in error
    sys.modules.pop("own_part")


def test_a_run_from_before_texts_were_kept_is_still_finished(fake, capsys):
    assert main(fake) == 0
    versions = json.loads(Path("o/versions.json").read_text())
    assert set(versions.pop("sources")) == {"recipe"}
    Path("o/versions.json").write_text(json.dumps(versions))
    assert told(capsys, *fake) == "giril: o was finished earlier: nothing was run.\n"


def test_an_unfinished_run_goes_on_with_other_settings_of_watching(fake):
    assert main([*fake, "stop=true"]) == 130
    assert main([*fake, "ppo.checkpoint_every=7", "eval.episodes=3", "eval.seed=5"]) == 0
    kept = yaml.safe_load(Path("o/config.yaml").read_text())
    assert kept["eval"] == {"episodes": 3, "seed": 5} and kept["ppo"]["checkpoint_every"] == 7
    assert json.loads(Path("o/result.json").read_text())["episodes"] == 3


def test_a_finished_policy_is_scored_anew_and_not_trained(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["run", "control", *TINY, "task.env_id=StepCounter-v0", "out=o", "eval.episodes=2"]
    error = told(capsys, *words, "steps=17")
    assert error == "giril: steps=17 is no multiple of a batch (2 * 8 = 16): 32 steps are taken.\n"
    before = json.loads(Path("o/result.json").read_text())
    assert before["env_steps"] == 32 and before["episodes"] == 2
    trained = {path: path.read_bytes() for path in Path("o").glob("*.safetensors")}
    words[-1:] = ["eval.episodes=3", "eval.seed=7", "steps=17"]
    assert (
        "o was finished earlier: its policy is scored anew, in 3 episodes of the seed 7; "
        in told(capsys, *words)
    )
    after = json.loads(Path("o/result.json").read_text())
    assert main(["eval", "o"]) == 0  # By the run's own settings, which are these from now on.
    again = json.loads(Path("o/eval.json").read_text())
    assert after["returns"] == again["returns"] and len(after["returns"]) == 3
    assert after["seeds"] == {**before["seeds"], "evaluation": 7}
    scores = set(again) & set(before)
    assert {key: after[key] for key in before if key not in {*scores, "seeds"}} == {
        key: before[key] for key in before if key not in {*scores, "seeds"}
    }
    assert {path: path.read_bytes() for path in trained} == trained
    assert told(capsys, *words).splitlines()[-1] == (
        "giril: o was finished earlier: nothing was run."
    )


def test_a_study_has_its_runs_scored_anew(fake):
    Path("mine.yaml").write_text("groups: [{label: a, recipe: fake.py}]")
    assert main([*fake[:2], "eval.episodes=3"]) == 0
    spec = read_spec(Path("mine.yaml"))
    for episodes, finished in ((3, True), (4, False)):
        (run,) = Planner(Path("runs")).plan(spec, [f"eval.episodes={episodes}"])
        assert run.has_result and run.finished == finished
