"""Files that would run code, read a secret or fill the memory where they were believed."""

import json
import os
import pickle
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from files import (
    SETTINGS,
    entries,
    kept,
    recipe,
    resumed,
    run_folder,
    spoilt_demonstration,
    text,
    tree,
    written,
)

from giril_rl.cli.command_line import main
from giril_rl.errors import UserError
from giril_rl.runs.checkpoint import load_state, save_state

CALL = '!!python/object/apply:os.system ["touch mark"]'
BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    + [f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 10)}]" for i in range(9)]
)
STRAY = {"device": "cpu", "shape": [5], "dtype": "torch.float32", "is_nested": False}


class Evil:
    """Leaves a mark where it is unpickled."""

    def __reduce__(self):
        return (Path("mark").touch, ())


@pytest.fixture(autouse=True)
def watched(here, monkeypatch):
    """A module that leaves a mark where it is imported, and a secret in the environment."""
    Path("evil_module.py").write_text("import pathlib; pathlib.Path('mark').touch()")
    monkeypatch.syspath_prepend(str(Path().resolve()))
    monkeypatch.setenv("SECRET", "hunter2")
    yield
    assert not Path("mark").exists() and "evil_module" not in sys.modules
    assert (here / "beside.txt").read_text() == "beside"
    for path in here.rglob("*"):
        small = path.is_file() and path.stat().st_size < 2**25
        assert not small or b"hunter2" not in path.read_bytes()


def pickled(name):
    def change(folder):
        torch.save({"x": Evil()}, folder / name)

    return change


def linked(name):
    def change(folder):
        elsewhere = Path("..", "elsewhere").resolve()
        (folder / name).replace(elsewhere)
        (folder / name).symlink_to(elsewhere)

    return change


def sparse(folder):
    """As large as the metadata says, and not on the disk."""
    name = folder / "transitions/action.memmap"
    os.truncate(name, 8 * 2**40)
    meta = json.loads((folder / "transitions/meta.json").read_text())
    meta["action"]["shape"] = [2**40]
    (folder / "transitions/meta.json").write_text(json.dumps(meta))


def frames(**members):
    def change(folder):
        with zipfile.ZipFile(folder / "frames.npz", "a") as archive:
            for name, content in members.items():
                archive.writestr(name.replace("__", "/"), content)

    kept("demonstration_of_images", change)
    return ["demo", "show", "demonstration_of_images"]


def group(content, folder="task"):
    Path(folder).mkdir()
    written(f"{folder}/mine.yaml", content)
    return recipe(SETTINGS.replace("inverted_pendulum", "mine"))


RUNS = "groups:\n- label: a\n  recipe: giril\n  "


def study(content):
    return ["study", written("mine.yaml", content), "--dry-run"]


def of(env_id, **others):
    """A run that says that its environment is another one."""
    settings = {"task": {"name": "a", "env_id": env_id}, "eval": {}, **others}
    return ["eval", run_folder(text("config.yaml", json.dumps(settings)))]


def played(**changes):
    """A run on a game that is continued from a checkpoint with other entries."""
    pytest.importorskip("ale_py")
    command = ["run", "expert", "task=breakout", "task.max_episode_steps=20", "steps=32"]
    command += ["ppo.num_envs=2", "ppo.rollout=8", "ppo.minibatch=16", "ppo.epochs=1"]
    command += ["eval.episodes=1", "logger=null", "out=game"]
    assert main(command) == 0
    Path("game/result.json").unlink()
    state = load_state("game/ppo.safetensors")
    for key, value in changes.items():
        state["simulator"][key][0] = value
    save_state("game/ppo.safetensors", {**state, "steps": 16})
    return command


CASES = {
    "hang: an action that the game does not have": (
        lambda: played(actions=99),
        "game/ppo.safetensors cannot be restored (ValueError: its actions are not between 0 and 3",
    ),
    "pickle: a checkpoint": (lambda: resumed(pickled("ppo.safetensors")), "is damaged"),
    "pickle: a policy": (
        lambda: ["eval", run_folder(pickled("policy/model.safetensors"))],
        "is damaged",
    ),
    "pickle: beside a demonstration": (
        lambda: spoilt_demonstration(
            lambda f: (f / "transitions/other.pickle").write_bytes(pickle.dumps(Evil()))
        ),
        "holds 'other.pickle', which is not a tensor",
    ),
    "pickle: frames": (lambda: frames(**{"x.npy": pickle.dumps(Evil())}), "holds "),
    "memmap: another class": (
        lambda: spoilt_demonstration(
            entries("transitions/meta.json", _type="<class 'tensordict.tensorclass.NonTensorData'>")
        ),
        "something other than a TensorDict",
    ),
    "memmap: a path": (
        lambda: spoilt_demonstration(entries("transitions/meta.json", **{"../../beside": STRAY})),
        "which is not a plain tensor",
    ),
    "memmap: a link": (
        lambda: spoilt_demonstration(linked("transitions/action.memmap")),
        "has the link 'action.memmap' in it",
    ),
    "memmap: sparse": (lambda: spoilt_demonstration(sparse), "more than this machine's memory"),
    "archive: a path": (lambda: frames(**{"..__..__beside.txt": b"overwritten"}), "holds ../../be"),
    "archive: an absolute path": (lambda: frames(**{"__tmp__x": b"overwritten"}), "holds /tmp/x"),
    "tag: a run's config": (
        lambda: ["eval", run_folder(text("config.yaml", f"task: {CALL}"))],
        "no readable config.yaml",
    ),
    "tag: a run that goes on": (
        lambda: resumed(text("config.yaml", f"task: {CALL}")),
        "config.yaml cannot be read",
    ),
    "tag: a study": (lambda: study(f"groups: {CALL}"), "correct it."),
    "tag: a recipe's settings": (lambda: recipe(SETTINGS + f"seed: {CALL}\n"), "is not valid YAML"),
    "tag: a task": (lambda: group(f"name: {CALL}\n"), "is not valid YAML, line 1"),
    "bomb: a task": (
        lambda: group(BOMB),
        "task/mine.yaml cannot be read as YAML: its aliases stand",
    ),
    "module: a run's environment": (
        lambda: of("evil_module:Env-v0"),
        "names the module evil_module, and reading a run imports nothing",
    ),
    "module: one that a run imports": (
        lambda: of("Env-v0", imports=["evil_module"]),
        "names the module evil_module, and reading a run imports nothing",
    ),
    "module: a game's": (lambda: of("evil_module:ALE/Pong-v5"), "names the module evil_module"),
    "module: imports that are none": (
        lambda: of("Env-v0", imports={"evil_module": [3]}),
        "is not a Gymnasium id",
    ),
    "module: a study's environment": (
        lambda: study(RUNS + "task.env_id: evil_module:Env-v0"),
        "a study's file alone imports nothing",
    ),
    "module: a study's imports": (
        lambda: study(RUNS + "imports: [evil_module]"),
        "a study's file alone imports nothing",
    ),
    "module: a demonstration's": (
        lambda: [
            "demo",
            "export",
            kept("demonstration", entries("card.json", env_id="evil_module:Env-v0")),
            "--minari",
            "mine/set-v0",
        ],
        "is not a Gymnasium id",
    ),
    "module: searchpath": (
        lambda: recipe(SETTINGS + "hydra: {searchpath: [pkg://evil_module]}\n"),
        "is not a key",
    ),
    "module: searchpath in the defaults": (
        lambda: recipe(SETTINGS.replace("  - _self_", "  - pkg://evil_module/x\n  - _self_")),
        "is not of the form `group: choice`",
    ),
    "module: Hydra's launcher": (
        lambda: recipe(SETTINGS.replace("  - _self_", "  - override hydra/launcher: x\n")),
        "is not of the form `group: choice`",
    ),
    "module: _target_": (
        lambda: recipe(SETTINGS + "ppo: {_target_: evil_module.x}\n"),
        "'ppo._target_' is not a key",
    ),
    "module: _target_ in a task": (
        lambda: group("name: a\nenv_id: CartPole-v1\n_target_: evil_module.x\n"),
        "cannot be composed",
    ),
    "path: a default": (
        lambda: recipe(SETTINGS.replace("task: inv", "task: ../../inv")),
        "is not of the form `group: choice`",
    ),
    "secret: a study": (
        lambda: study('groups: [{label: a, recipe: giril, logger: "${oc.env:SECRET}"}]'),
        "only ${other.key}",
    ),
    "secret: a recipe's settings": (
        lambda: recipe(SETTINGS + "task: {name: '${oc.env:SECRET}'}\n"),
        "only ${other.key}",
    ),
    "secret: a task": (
        lambda: group("name: ${oc.env:SECRET}\nenv_id: CartPole-v1\n"),
        "only ${other.key}",
    ),
    "secret: a run": (lambda: of("${oc.env:SECRET}"), "${oc.env:SECRET} is not a Gymnasium id"),
    "bomb: a run's config": (
        lambda: ["eval", run_folder(text("config.yaml", BOMB))],
        "no readable config.yaml",
    ),
    "bomb: a study": (lambda: study(BOMB), "aliases stand for more than"),
    "bomb: a recipe's settings": (lambda: recipe(BOMB), "aliases stand for more than"),
    "bomb: a list in itself": (lambda: study("groups: &a [*a]"), "inside of"),
    "bomb: a deep study": (lambda: study("a: " + "[" * 5000 + "]" * 5000), "nested too deeply"),
    "bomb: a card": (
        lambda: spoilt_demonstration(text("card.json", " " * (17 * 2**20))),
        "more than 16,777,216 bytes",
    ),
}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("case", CASES)
def test_a_hostile_file_is_refused_in_one_sentence(case, here, capsys):
    argv, sentence = CASES[case]
    argv = argv()
    sizes = {path: path.stat().st_size for path in here.rglob("*")}
    before = tree(here) if case != "memmap: sparse" else None
    assert main(argv) == 2, capsys.readouterr().err
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith("giril: ") and line[-1] in ".?" and len(line) < 600
    assert sentence in line and "hunter2" not in line
    assert before is None or tree(here) == before
    assert {path: path.stat().st_size for path in here.rglob("*")} == sizes


def card(**changes):
    """A saved reward whose card says something else of how it is made."""

    def change(folder):
        path = folder / "reward/card.json"
        value = json.loads(path.read_text())
        value["made_by"] = {**value["made_by"], **changes}
        path.write_text(json.dumps(value))

    return change


def argument(**changes):
    def change(folder):
        value = json.loads((folder / "reward/card.json").read_text())["made_by"]["arguments"]
        card(arguments={**value, **changes})(folder)

    return change


REWARDS = {
    "another class": (card(**{"class": "os.system"}), "is of a os.system"),
    "a class that is a list": (card(**{"class": ["x"]}), "not of a GenerativeReward"),
    "another method": (card(constructor="load_state_dict"), "has no constructor"),
    "an object's method": (card(constructor="__reduce__"), "has no constructor"),
    "a constructor without a record": (card(constructor="__init__"), "no constructor '__init__'"),
    "a constructor that is a list": (card(constructor=["for_vectors"]), "has no constructor"),
    "text for a constructor": (entries("reward/card.json", made_by="os.system"), "is of a None"),
    "no arguments": (card(arguments=None), "cannot be made"),
    "an argument missing": (card(arguments={"observation_dim": 3}), "cannot be made"),
    "a huge network": (argument(hidden=[10**6, 10**6, 10**6]), "does not fit its card"),
    "more than there is": (argument(hidden=[2**62, 2**62]), "cannot be made"),
    "many layers": (argument(hidden=[1] * 20_000), "cannot be made (a list of 20,000 entries)"),
    "other sizes": (argument(hidden=[9]), "does not fit its card"),
    "an unknown argument": (argument(command="rm"), "cannot be made"),
    "text for a number": (argument(beta="1"), "cannot be made"),
    "an unknown action spec": (argument(action_spec={"action_spec": "os"}), "cannot be made"),
    "a later format": (entries("reward/card.json", format_version=2), "upgrade giril_rl"),
    "no format": (entries("reward/card.json", drop=["format_version"]), "save its module anew"),
    "too deep": (text("reward/card.json", '{"a":' * 50_000), "nested too deeply"),
    "not JSON": (text("reward/card.json", "{"), "cannot be read as JSON"),
    "no weights": (lambda f: (f / "reward/model.safetensors").unlink(), "holds no saved module"),
    "weights cut short": (lambda f: os.truncate(f / "reward/model.safetensors", 999), "is damaged"),
    "a pickle": (pickled("reward/model.safetensors"), "is damaged"),
    "another's weights": (
        lambda f: (f / "policy/model.safetensors").replace(f / "reward/model.safetensors"),
        "does not fit its card",
    ),
}


@pytest.mark.parametrize("case", REWARDS)
def test_a_wrong_or_hostile_reward_is_refused(case, here):
    from giril_rl.rewards import GenerativeReward

    change, sentence = REWARDS[case]
    folder = kept("run", change)
    before = tree(here)
    with pytest.raises(UserError) as refusal:
        GenerativeReward.from_pretrained(Path(folder) / "reward")
    assert sentence in str(refusal.value) and str(refusal.value)[-1] == "."
    assert tree(here) == before


def test_hydras_own_settings_in_a_task_do_nothing(here):
    """Hydra makes what `hydra.callbacks` names only where it owns the process."""
    content = "# @package _global_\nhydra: {callbacks: {a: {_target_: evil_module.x}}}\n"
    main(group(content + "task: {name: a, env_id: None-v9}\n"))


@pytest.mark.slow
def test_a_study_s_status_leads_nowhere(here, capsys):
    run_folder()
    Path("studies/x").mkdir(parents=True)
    row = {"state": "failed", "folder": "../../secrets", "last_line": "\x1b[2J"}
    Path("studies/x/status.json").write_text(json.dumps({"runs": [row]}))
    assert main(["report", ".", "--out", "report"]) == 0
    assert "secrets" not in Path("report/report.md").read_text()


def test_the_canaries_sing(here):
    """Each of the ways in would leave its mark, were it open."""
    import yaml

    for way in (
        lambda: pickle.loads(pickle.dumps(Evil())),
        lambda: yaml.load(CALL, Loader=yaml.UnsafeLoader),
        lambda: __import__("evil_module"),
    ):
        way()
        assert Path("mark").exists()
        Path("mark").unlink()
    del sys.modules["evil_module"]
