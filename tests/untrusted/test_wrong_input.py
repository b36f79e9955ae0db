"""Wrong input at the command line: one sentence, exit code 2, nothing on disk changed.

Wrong data sets to import are in tests/demos/test_import_wrong.py.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from files import (
    SETTINGS,
    cut,
    demonstration,
    entries,
    gone,
    kept,
    recipe,
    resumed,
    run_folder,
    spoilt_demonstration,
    text,
    tree,
    words,
    written,
)

from giril_rl.cli.command_line import main

DEEP = '{"a":' * 50_000 + "1" + "}" * 50_000


def giril(*texts):
    return lambda: ["run", "giril", *texts]


def study(content):
    return lambda: ["study", written("mine.yaml", content), "--dry-run"]


def group(knobs):
    return study(f"groups:\n  - label: a\n    recipe: giril\n{knobs}")


def evaluated(change):
    return lambda: ["eval", run_folder(change)]


def reported(change):
    return lambda: ["report", str(Path(run_folder(change)).parent.resolve())]


MODE = {"return_mean": 1.0, "return_std": 0.0, "return_median": 1.0}
RESULTS = {
    "seeds that are a list": ("seeds", {"seeds": [1]}),
    "a seed that is text": ("seeds.reward", {"seeds": {"reward": "1"}}),
    "a name that is a seed's": ("seeds", {"seeds": {"\n": "1"}}),
    "a mode that is text": ("deterministic", {"deterministic": "x"}),
    "a mode without its length": ("deterministic.episode_length_mean", {"deterministic": MODE}),
    "an expert's score that is text": ("expert_return_mean", {"expert_return_mean": "x"}),
    "a score that is NaN": ("return_mean", {"return_mean": float("nan")}),
    "an infinite score": ("demo_return_mean", {"demo_return_mean": float("inf")}),
    "a score that is a truth": ("return_mean", {"return_mean": True}),
    "a score beyond all numbers": ("return_median", {"return_median": 10**400}),
    "episodes below zero": ("episodes", {"episodes": -1}),
    "steps beyond all numbers": ("env_steps", {"env_steps": 10**20}),
    "a speed that is text": ("steps_per_second", {"steps_per_second": "1"}),
    "a life that is text": ("life_length_mean", {"life_length_mean": "1"}),
    "a method of two lines": ("method", {"method": "giril\n# Results"}),
}


def number(name, value, row=3):
    """Puts a number into one of a demonstration's columns, in all places where it belongs."""

    def change(data):
        data[name][row] = value
        if name == "observation":
            data["next", name][row - 1] = value

    return change


def checkpoint(change):
    def rewrite(folder):
        from giril_rl.runs.checkpoint import load_state, save_state

        state = load_state(folder / "ppo.safetensors")
        save_state(folder / "ppo.safetensors", change(state))

    return rewrite


def without_weights(state):
    agent = state["algorithm"]["agent"]
    state["algorithm"]["agent"] = {key: value[:1] for key, value in agent.items() if value.ndim}
    return state


def saved_as(version):
    def rewrite(folder):
        from safetensors.torch import save_file

        about = {"format_version": version, "structure": "{}", "crc32": "0"}
        save_file({"x": torch.zeros(1)}, folder / "ppo.safetensors", about)

    return rewrite


def folder_of(**files):
    def make():
        Path("there").mkdir()
        for name, content in files.items():
            Path("there", name).write_text(content)
        return "there"

    return make


def below_a_file():
    written("file", "")
    return words("out=file/run")


def at_a_file():
    written("file", "")
    return words("out=file")


def images(change):
    kept("demonstration_of_images", change)
    return ["demo", "show", "demonstration_of_images"]


def expert(change):
    return lambda: words("demo.path=null", f"expert.path={run_folder(change)}", "out=new")


RUN = {
    # Most refusals of the words themselves are in tests/config and tests/cli.
    "recipe: none": (lambda: ["run"], "name a recipe"),
    "option: unknown": (lambda: ["run", "giril", "--sed=1"], "unrecognized arguments: --sed=1"),
    "task: unknown": (giril("task=inverted_pendulm"), "choose one of ant, atari,"),
    "task: a path": (giril("task=../profile/paper"), "choose one of ant"),
    "task: unknown id": (giril("task.env_id=CartPoll-v1"), "is not a Gymnasium id"),
    "task: a module's id": (giril("task.env_id=os:No-v1"), "is not a Gymnasium id that os"),
    "task: an id of no module": (giril("task.env_id=no_such:CartPole-v1"), "no module no_such"),
    "key: in the wrong part": (giril("reward.lr=1"), "did you mean 'fit.lr' or 'ppo.lr'"),
    "key: of another recipe": (giril("bc.steps=9"), "'bc.steps' is not a key of giril"),
    "key: Hydra's": (giril("hydra.searchpath=[pkg://os]"), "is not a key of giril"),
    "key: Hydra's group": (giril("hydra/launcher=x"), "is not a key of giril"),
    "key: _target_": (giril("reward._target_=os.system"), "'reward._target_' is not a key"),
    "type: text": (giril("seed=x"), "seed=x: a whole number is needed."),
    "type: mixed list": (giril("ppo.hidden=[64,a]"), "a list of whole numbers"),
    "type: unreadable": (giril("seed=[1"), "the value cannot be read"),
    "value: last job of a sweep": (giril("-m", "reward.beta=1,2"), "must be less than or equal"),
    "value: a large seed of a part": (giril(f"demo.seed={2**64}"), "demo.seed=1844674407370955161"),
    "value: thousands of digits": (giril("seed=" + "9" * 5_000), "the value cannot be read"),
    "value: a number too large": (giril("ppo.lr=" + "9" * 400), "a number is needed"),
    "value: NaN": (giril("reward.beta=nan"), "reward.beta=nan must be a finite number."),
    "steps: minibatch": (giril("ppo.minibatch=300"), "does not divide ppo.num_envs * ppo.rollout"),
    "steps: cloning": (lambda: ["run", "bc", "steps=10"], "cloning takes no environment steps"),
    "demo: both lengths": (giril("demo.episodes=1"), "give exactly one of them"),
    "reference: environment": (giril("logger=${oc.env:HOME}"), "only ${other.key}"),
    "reference: decoded": (giril("task.name=${oc.decode:x}"), "only ${other.key}"),
    "reference: nested": (giril("task.name='${oc.${profile}:x}'"), "only ${other.key}"),
    "reference: nowhere": (giril("task.name=${nowhere}"), "'nowhere' not found; write"),
    "reference: itself": (giril("task.name=${task.name}"), "Recursive interpolation"),
}
DEMONSTRATIONS = {
    "nowhere": (lambda: words("demo.path=nowhere"), "nowhere is not a demonstration"),
    "a file": (lambda: words(f"demo.path={written('file', '')}"), "is not a demonstration"),
    "empty": (lambda: demonstration(lambda data: data[:0]), "is empty"),
    "one transition": (lambda: demonstration(lambda data: data[:1]), "has only one transition"),
    "of another task": (
        lambda: demonstration(
            lambda data: data.update(
                {
                    "observation": data["observation"][:, :2],
                    "next": {"observation": data["next", "observation"][:, :2]},
                }
            )
        ),
        "2 numbers in an observation and the task has 4",
    ),
    "of another action space": (
        lambda: demonstration(lambda data: data.set("action", torch.zeros(40, 1))),
        "has continuous actions and the task discrete ones",
    ),
    "action out of range": (
        lambda: demonstration(number("action", 2)),
        "has the action 2 at index 3, outside [0, 1]",
    ),
    "misaligned": (
        lambda: demonstration(lambda data: data.set("observation", data["observation"].roll(1, 0))),
        "is misaligned",
    ),
    "NaN": (lambda: demonstration(number("observation", np.nan)), "has NaN or infinity in"),
    "infinity": (lambda: demonstration(number("observation", np.inf)), "has NaN or infinity in"),
    "step out of order": (lambda: demonstration(number("step", 9)), "has step 9 of episode 0 out"),
    "a column missing": (
        lambda: demonstration(lambda data: data.exclude("action")),
        "has no 'action'",
    ),
    "file cut short": (
        lambda: spoilt_demonstration(cut("transitions/action.memmap")),
        "has 160 bytes instead of 320",
    ),
    "file missing": (
        lambda: spoilt_demonstration(gone("transitions/next/done.memmap")),
        "done.memmap is missing",
    ),
    "metadata missing": (
        lambda: spoilt_demonstration(gone("transitions/meta.json")),
        "is damaged",
    ),
    "metadata too deep": (
        lambda: spoilt_demonstration(text("transitions/meta.json", DEEP)),
        "nested too deeply",
    ),
    "metadata of another device": (
        lambda: spoilt_demonstration(entries("transitions/meta.json", device="meta")),
        "has damaged metadata",
    ),
    "card cut short": (lambda: spoilt_demonstration(cut("card.json")), "cannot be read as JSON"),
    "card too deep": (lambda: spoilt_demonstration(text("card.json", DEEP)), "nested too deeply"),
    "card not an object": (
        lambda: spoilt_demonstration(text("card.json", "[1]")),
        "does not hold a JSON object",
    ),
    "card not UTF-8": (
        lambda: spoilt_demonstration(lambda f: (f / "card.json").write_bytes(b"\xff{}")),
        "cannot be read as JSON",
    ),
    "of a later format": (
        lambda: spoilt_demonstration(entries("card.json", format_version=3)),
        "written by a later giril_rl (this one reads up to 2): upgrade giril_rl.",
    ),
    "of no format": (
        lambda: spoilt_demonstration(entries("card.json", format_version="1")),
        "format '1', and this giril_rl reads only 1 and 2: export it as .npz",
    ),
    "images missing": (lambda: images(gone("frames.npz")), "and no frames.npz"),
    "images cut short": (lambda: images(cut("frames.npz")), "frames.npz is damaged"),
    "images of other sizes": (
        lambda: images(entries("card.json", frames={"planes": 5, "shape": [2, 6, 7]})),
        "instead of uint8",
    ),
}
PLACES = {
    "out: a file": (at_a_file, "file is a file: choose another out=."),
    "out: below a file": (below_a_file, "file/run cannot be made, for file is a file"),
    "out: too long": (lambda: words(f"out={'x' * 300}"), "cannot be written (File name too long)"),
    "out: somebody's folder": (
        lambda: kept("demonstration") and words(f"out={folder_of(thesis='years')()}"),
        "is not a run's folder and is not empty (it holds thesis)",
    ),
    "out: shared by two jobs": (giril("-m", "seed=0,1", "out=o"), "two jobs would share the"),
    "root: a file": (
        lambda: words(f"root={written('file', '')}", "demo.path=null"),
        "choose another root=.",
    ),
    "run: of other settings": (
        lambda: resumed(lambda folder: None) and words("ppo.lr=0.1"),
        "was made with other settings (ppo.lr: 0.0003 there, 0.1 now)",
    ),
    "run: config cut short": (
        lambda: resumed(text("config.yaml", "recipe: [")),
        "config.yaml cannot be read",
    ),
    "run: of a later format": (
        lambda: resumed(entries("versions.json", format_version=3)),
        "run has run format 3, written by a later giril_rl",
    ),
    "checkpoint: cut short": (lambda: resumed(cut("ppo.safetensors")), "is damaged or not a giril"),
    "checkpoint: of the part before": (lambda: resumed(cut("fit.safetensors")), "is damaged"),
    "checkpoint: empty": (lambda: resumed(text("ppo.safetensors", "")), "is damaged"),
    "checkpoint: of a later version": (
        lambda: resumed(saved_as("2")),
        "checkpoint format 2, written by a later giril_rl",
    ),
    "checkpoint: of no version": (lambda: resumed(saved_as("x")), "reads only 1: finish with"),
    "checkpoint: of another part": (
        lambda: resumed(checkpoint(lambda state: {"step": 1})),
        "if it is a checkpoint of another run or task",
    ),
    "checkpoint: of other sizes": (
        lambda: resumed(checkpoint(without_weights)),
        "if it is a checkpoint of another run or task",
    ),
    "expert: nowhere": (
        lambda: words("demo.path=null", "expert.path=nowhere"),
        "nowhere holds no finished run",
    ),
    "expert: unfinished": (expert(gone("result.json")), "holds no finished run"),
    "expert: of another task": (expert(entries("result.json", task="x")), "plays x, not CartPole"),
    "expert: result of nothing": (
        expert(entries("result.json", drop=["config_hash"])),
        "has no config_hash",
    ),
    "expert: policy cut short": (expert(cut("policy/model.safetensors")), "is damaged"),
}
LEFT_BEHIND = {
    "eval: nowhere": (lambda: ["eval", "nowhere"], "there is no run folder nowhere"),
    "eval: a file": (lambda: ["eval", written("file", "")], "there is no run folder file"),
    "eval: an empty folder": (lambda: ["eval", "."], "holds no finished run"),
    "eval: unfinished": (evaluated(gone("result.json")), "holds no finished run"),
    "eval: result cut short": (evaluated(cut("result.json")), "cannot be read as JSON"),
    "eval: result too deep": (evaluated(text("result.json", DEEP)), "nested too deeply"),
    "eval: result of nothing": (evaluated(text("result.json", "{}")), "has no method as a run"),
    "eval: result of another type": (evaluated(entries("result.json", seed="x")), "has no seed"),
    "eval: of a later format": (
        evaluated(entries("versions.json", format_version=7)),
        "upgrade giril_rl",
    ),
    "eval: no config": (evaluated(gone("config.yaml")), "no readable config.yaml"),
    "eval: config of one word": (evaluated(text("config.yaml", "word")), "no readable config.yaml"),
    "eval: config without a task": (evaluated(text("config.yaml", "eval: {}")), "no readable"),
    "eval: config of another type": (
        evaluated(text("config.yaml", "{task: {name: a, env_id: 5}, eval: {}}")),
        "config.yaml: task.env_id=5 must be a valid string.",
    ),
    "eval: config out of range": (
        evaluated(text("config.yaml", "{task: {name: a, env_id: b}, eval: {episodes: 0}}")),
        "config.yaml: eval.episodes=0 must be greater than or equal to 1.",
    ),
    "eval: config of an unknown id": (
        evaluated(text("config.yaml", "{task: {name: a, env_id: b}, eval: {}}")),
        "task.env_id=b is not a Gymnasium id",
    ),
    "eval: another task's policy": (
        evaluated(text("config.yaml", "{task: {name: a, env_id: Pendulum-v1}, eval: {}}")),
        "does not fit a: it belongs to another task's run",
    ),
    "eval: no weights": (evaluated(gone("policy/model.safetensors")), "holds no saved module"),
    "eval: weights cut short": (evaluated(cut("policy/model.safetensors")), "is damaged"),
    "eval: card too deep": (evaluated(text("policy/card.json", DEEP)), "nested too deeply"),
    "eval: a reward's card": (
        evaluated(lambda f: (f / "reward/card.json").replace(f / "policy/card.json")),
        "is of a GenerativeReward, not of a ActorCritic",
    ),
    "report: nowhere": (lambda: ["report", "nowhere"], "there is no folder nowhere"),
    "report: no runs": (lambda: ["report", "."], "there is no finished run below ."),
    "report: result cut short": (reported(cut("result.json")), "cannot be read as JSON"),
    **{
        f"eval: {name} in a result": (
            evaluated(entries("result.json", **change)),
            f"has no {key} as a run writes it",
        )
        for name, (key, change) in RESULTS.items()
    },
    "report: no standard deviation": (
        reported(entries("result.json", drop=["return_std"])),
        "has no return_std",
    ),
    "report: result of nothing": (reported(text("result.json", "{}")), "has no method"),
    "report: of a later format": (
        reported(entries("versions.json", format_version=3)),
        "upgrade giril_rl",
    ),
    "report: into a file": (
        lambda: ["report", run_folder(), "--out", written("file", "")],
        "file is a file: choose another --out.",
    ),
    "show: a run": (lambda: ["demo", "show", run_folder()], "is not the folder of a demonstration"),
}
WRITTEN = {
    # Most refusals of a study's file are in tests/experiments/study.
    "study: not YAML": (study("groups: ["), "mine.yaml is not valid YAML, line 1: "),
    "study: not UTF-8": (study(b"\xff\xfe\x00"), "cannot be read as YAML"),
    "study: a key twice": (study("title: a\ntitle: b\n"), "found duplicate key title"),
    "study: unknown knob": (group("    sed: 1\n"), "'sed' is not a key of giril"),
    "study: beta": (group("    reward.beta: [1, 2]\n"), "must be less than or equal to 1"),
    "study: root is a file": (
        lambda: ["study", "smoke", f"root={written('file', '')}"],
        "choose another root=.",
    ),
    "copy: not Python": (lambda: recipe(SETTINGS, "def"), "is not valid Python"),
    "copy: null bytes": (lambda: recipe(SETTINGS, '"""a"""\0'), "Python"),
    "copy: not UTF-8": (lambda: recipe(SETTINGS, b'"""\xff"""'), "is not Python as UTF-8"),
    "copy: empty": (lambda: recipe(SETTINGS, ""), "begins with no docstring"),
    "copy: no Config": (lambda: recipe(SETTINGS, '"""a"""'), "has no `Config`"),
    "copy: settings empty": (lambda: recipe(""), "needs a `defaults` list"),
    "copy: settings not UTF-8": (lambda: recipe(b"\xff"), "mine.yaml cannot be read"),
    "copy: defaults not a list": (lambda: recipe("defaults: recipe_schema"), "needs a `defaults`"),
    "copy: unknown key": (lambda: recipe(SETTINGS + "foo: 1\n"), "'foo' is not a key of mine.py"),
    "copy: wrong type": (lambda: recipe(SETTINGS + "seed: x\n"), "a whole number is needed"),
    "copy: a date": (lambda: recipe(SETTINGS + "seed: !!timestamp 2020-01-01\n"), "mine.yaml"),
    "copy: unknown choice": (
        lambda: recipe(SETTINGS.replace("inverted_pendulum", "nothing")),
        "cannot be composed",
    ),
}
CASES = {
    **RUN,
    **{f"demonstration: {name}": case for name, case in DEMONSTRATIONS.items()},
    **PLACES,
    **LEFT_BEHIND,
    **WRITTEN,
}


@pytest.mark.parametrize("case", CASES)
def test_wrong_input_is_refused_in_one_sentence_and_changes_nothing(case, here, capsys):
    argv, sentence = CASES[case]
    argv = argv()
    before = tree(here)
    assert main(argv) == 2, capsys.readouterr().err
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if "%|" not in line and line.strip()]
    assert len(lines) == 1 and captured.out == "", captured
    assert sentence in lines[0]
    assert lines[0].startswith("giril: ") and lines[0][-1] in ".?"
    assert tree(here) == before


@pytest.mark.parametrize("argv", [["run", "giril", "seed=x"], ["eval", "nowhere"]])
def test_a_traceback_is_shown_only_when_asked_for(argv, here):
    command = [sys.executable, "-m", "giril_rl", *argv]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    asked = subprocess.run([*command, "--traceback"], capture_output=True, text=True)
    assert asked.returncode == 2 and asked.stderr.startswith("Traceback")
    assert asked.stderr.splitlines()[-1] == done.stderr.strip()


def test_a_run_in_use_by_another_process_is_left_alone(here, capsys):
    run_folder(finished=False)
    code = (
        "import sys; from filelock import FileLock; lock = FileLock('run/.lock'); lock.acquire(); "
    )
    code += "print('held', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout.readline() == "held\n"
        before = tree(here)
        assert main(words()) == 2
        assert tree(here) == before
        holder.stdin.close()
    assert "run is in use by another process: wait for it to end" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="needs a folder that nobody can write to")
@pytest.mark.parametrize("key", ["out", "root"])
def test_a_folder_that_cannot_be_made_is_refused(key, here, capsys):
    kept("demonstration")
    texts = words(f"{key}=/proc/none/run", *(["out=null"] if key == "root" else []))
    before = tree(here)
    assert main(texts) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert tree(here) == before


@pytest.mark.skipif(sys.platform != "linux", reason="needs a folder that nobody can write to")
def test_a_root_that_nothing_goes_to_is_not_looked_at(here):
    kept("demonstration")
    assert main(words("root=/proc/none")) == 0


def test_the_tree_sees_every_kind_of_change(here):
    Path("a").write_text("1")
    before = tree(here)
    assert json.dumps(before)
    for change in (
        lambda: Path("a").write_text("2"),
        lambda: Path("b").touch(),
        lambda: Path("c").mkdir(),
        lambda: Path("d").symlink_to("a"),
    ):
        change()
        after = tree(here)
        assert after != before
        before = after
