"""Wrong and hostile data sets: each refused in one sentence, with nothing written."""

import json
import pickle
from pathlib import Path

import datasets
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from wrong import (
    STRAY,
    Evil,
    archive,
    bomb,
    columns,
    cut_short,
    elsewhere,
    external,
    first,
    half,
    hdf5,
    huge,
    link,
    memmap,
    meta,
    minari,
    objects,
    parts,
    put,
    raw,
    renamed,
    soft,
    stray,
    texts,
    whole,
    with_value,
    without,
)

from giril_rl.cli.command_line import main


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    (tmp_path / "work").mkdir()
    (tmp_path / "secret.npy").write_bytes(b"secret")
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("MINARI_DATASETS_PATH", "minari")


def contents(folder):
    return {
        path: path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
        if not path.is_symlink()
    }


def refused(capsys, *argv):
    before = contents(Path().resolve().parent)
    assert main(argv) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert captured.out == "" and "Traceback" not in captured.err
    assert line.startswith("giril: ") and line[-1] in ".?"
    assert contents(Path().resolve().parent) == before
    return line


CASES = {
    # An .npz file with one row per transition.
    "columns: no file": (lambda: "none.npz", "there is no file none.npz"),
    "columns: no next states": (lambda: columns(next_observation=None), "next states are missing"),
    "columns: no actions": (lambda: columns(action=None), "has no action: needed are"),
    "columns: no ends": (lambda: columns(truncated=None), "has no truncated"),
    "columns: misaligned": (
        lambda: columns(observation=lambda x: np.roll(x, 1, 0)),
        "is misaligned: next.observation[0] is not observation[1]",
    ),
    "columns: an end not marked": (
        lambda: columns(terminated=put(2, False)),
        "or an end is not marked",
    ),
    "columns: lost end": (
        lambda: columns(truncated=put(4, False)),
        "episode 1 that stops at index 4 without done",
    ),
    "columns: NaN": (
        lambda: columns(action=put(3, np.nan)),
        "NaN or infinity in action at index 3",
    ),
    "columns: infinity": (lambda: columns(reward=put(0, np.inf)), "infinity in next.reward"),
    "columns: too large for float32": (
        lambda: columns(reward=np.full(5, 1e300)),
        "infinity in next.reward at index 0",
    ),
    "columns: empty": (
        lambda: columns(**{name: value[:0] for name, value in datasets.columns().items()}),
        "is empty",
    ),
    "columns: one transition": (
        lambda: columns(**{name: value[2:3] for name, value in datasets.columns().items()}),
        "has only one transition",
    ),
    "columns: a row too few": (
        lambda: columns(action=lambda x: x[:-1]),
        "4 rows of action and 5 of observation",
    ),
    "columns: a single number": (lambda: columns(reward=np.float32(1)), "0 of reward"),
    "columns: wrong space": (
        lambda: columns(
            observation=lambda x: np.hstack([x, x]), next_observation=lambda x: np.hstack([x, x])
        ),
        "6 numbers in an observation and the task has 3",
    ),
    "columns: another number of actions": (
        lambda: columns(action=lambda x: np.hstack([x, x])),
        "2 numbers in an action and the task has 1",
    ),
    "columns: discrete actions": (
        lambda: columns(action=np.zeros(5, np.int64)),
        "discrete actions and the task continuous",
    ),
    "columns: action out of bounds": (
        lambda: columns(action=put(1, 2.5)),
        "action [2.5] at index 1, outside [[-2.0], [2.0]]",
    ),
    "columns: a huge action": (
        lambda: columns(action=np.full(5, 2**64 - 1, np.uint64)),
        "no task has so many",
    ),
    "columns: images without channels": (
        lambda: columns(observation=np.zeros((5, 8, 8), np.uint8)),
        "observation of uint8 and shape [5, 8, 8]: vectors must be [N, d], images uint8 [N, c, h,",
    ),
    "columns: flags of numbers": (
        lambda: columns(terminated=lambda x: x.astype(np.float32)),
        "terminated of float32 and shape [5]: it must be bool",
    ),
    "columns: complex numbers": (
        lambda: columns(reward=lambda x: x.astype(np.complex64)),
        "reward in the .npz file is of complex64",
    ),
    "columns: images in [0, 1]": (
        lambda: columns(observation=np.zeros((5, 4, 8, 8), np.float32)),
        "images must be uint8",
    ),
    "columns: images for vectors": (
        lambda: columns(
            observation=np.zeros((5, 4, 8, 8), np.uint8),
            next_observation=np.zeros((5, 4, 8, 8), np.uint8),
        ),
        "observations of shape [4, 8, 8] and the task of shape [3]",
    ),
    "columns: a wrong name": (lambda: columns(rewrad=np.zeros(5)), "did you mean"),
    "columns: a short name": (
        lambda: renamed(datasets.columns(), observation="obs", reward="rews"),
        "has no observation: needed are observation, action, next_observation, terminated, "
        "truncated; did you mean 'observation' by 'obs'?",
    ),
    "columns: D4RL's names": (
        lambda: renamed(
            datasets.columns(),
            observation="observations",
            action="actions",
            next_observation="next_observations",
            reward="rewards",
            terminated="terminals",
            truncated="timeouts",
        ),
        "'observation' by 'observations' and 'action' by 'actions' and 'next_observation' by "
        "'next_observations' and 'terminated' by 'terminals' and 'truncated' by 'timeouts'?",
    ),
    "columns: one end for both": (
        lambda: renamed(datasets.columns(), truncated="dones"),
        "truncated: needed are observation, action, next_observation, terminated, truncated.",
    ),
    "columns: an array too many": (
        lambda: columns(infos=np.zeros(5)),
        "'infos.npy' in the .npz file is not an array of a demonstration; leave it out.",
    ),
    "columns: text": (lambda: columns(reward=np.array(["a"] * 5)), "not plain numbers"),
    "columns: objects": (lambda: columns(action=objects()), "nothing is unpickled"),
    "columns: a pickle": (
        lambda: raw("set.npz", pickle.dumps(Evil())),
        "is no .npz file, or was cut short",
    ),
    "columns: truncated file": (lambda: half(columns, "set.npz"), "was cut short"),
    "columns: a path": (lambda: archive(**{"..__secret.npy": b""}), "'../secret.npy' in the .npz"),
    "columns: twice": (lambda: archive(**{"action.npy": b""}), "holds 'action.npy' twice"),
    "columns: a bomb": (bomb, "has not the size that it says"),
    # An .npz file of whole episodes.
    "whole: next states missing": (
        lambda: whole(observations=lambda x: x[:5]),
        "5 rows of observations and lengths ask for 7",
    ),
    "whole: an episode cut": (lambda: whole(actions=lambda x: x[:-1]), "4 rows of actions"),
    "whole: no lengths": (lambda: whole(lengths=None), "needed are observation"),
    "whole: other names": (
        lambda: renamed(datasets.whole(), observations="obs", lengths="episode_lengths"),
        "'observations' by 'obs' and 'lengths' by 'episode_lengths'?",
    ),
    "whole: no ends": (lambda: whole(terminated=None), "has lengths and no terminated"),
    "whole: an empty episode": (lambda: whole(lengths=np.array([5, 0])), "of at least 1"),
    "whole: no episode": (lambda: whole(lengths=np.array([], int)), "of at least 1"),
    "whole: lengths of floats": (lambda: whole(lengths=np.array([3.0, 2.0])), "must be integers"),
    "whole: an end too many": (
        lambda: whole(terminated=np.ones(3, bool)),
        "one per episode, as lengths is",
    ),
    "whole: both kinds": (lambda: whole(reward=np.zeros(5)), "has both lengths"),
    "whole: NaN": (
        lambda: whole(observations=put(4, np.nan)),
        "NaN or infinity in observation at index 3",
    ),
    # A Minari dataset.
    "minari: none": (lambda: "minari:none-v0", "there is no local Minari dataset none-v0"),
    "minari: a path": (lambda: "minari:../secret-v0", "is not the id of a Minari dataset"),
    "minari: no version": (lambda: "minari:set", "is not the id of a Minari dataset"),
    "minari: empty": (lambda: minari(list.clear), "is empty"),
    "minari: cut short": (lambda: minari(total_episodes=3), "says that it has 3 episodes"),
    "minari: another format": (lambda: minari(data_format="arrow"), "only its HDF5 format"),
    "minari: damaged metadata": (
        lambda: minari() and raw("minari/set-v0/data/metadata.json", b"{") and "minari:set-v0",
        "damaged metadata",
    ),
    "minari: truncated file": (
        lambda: half(minari, "minari/set-v0/data/main_data.hdf5"),
        "is damaged or was cut short",
    ),
    "minari: next states missing": (
        first("observations", lambda x: x[:-1]),
        "episode 0 of the data set has 3 observations and 3 actions",
    ),
    "minari: rewards missing": (first("rewards", lambda x: x[1:]), "2 rows of reward"),
    "minari: end missing": (
        first("terminations", np.zeros_like),
        "has an episode 0 that stops at index 2 without done",
    ),
    "minari: goes on after done": (
        first("truncations", put(0, True)),
        "goes on after done at index 0, in the middle of episode 0",
    ),
    "minari: action out of bounds": (first("actions", lambda x: x * 9), "outside"),
    "minari: infinity": (first("observations", put(1, -np.inf)), "infinity in observation"),
    "minari: several parts": (lambda: hdf5(parts), "of several parts"),
    "minari: texts": (lambda: hdf5(texts), "not plain numbers"),
    "minari: no actions": (lambda: hdf5(lambda *_: None), "has no actions"),
    "minari: another file": (lambda: hdf5(external), "has a link for actions"),
    "minari: a link": (lambda: hdf5(soft), "has a link for actions"),
    "minari: data elsewhere": (lambda: hdf5(elsewhere), "has actions in another file"),
    "minari: a bomb": (lambda: hdf5(huge), "larger than its file"),
    # The folder of a TensorDict.
    "memmap: nowhere": (lambda: "nowhere", "is neither minari:NAME, nor"),
    "memmap: another folder": (lambda: Path("x").mkdir() or "x", "(no meta.json)"),
    "memmap: no next states": (
        lambda: memmap(without(("next", "observation"))),
        "next states are missing",
    ),
    "memmap: no actions": (lambda: memmap(without("action")), "has no action"),
    "memmap: a short name": (
        lambda: memmap(lambda data: data.rename_key_(("next", "observation"), ("next", "obs"))),
        "next.truncated; did you mean 'next.observation' by 'next.obs'?",
    ),
    "memmap: not flat": (
        lambda: memmap(lambda data: data[:4].reshape(2, 2)),
        "has the batch shape [2, 2]",
    ),
    "memmap: misaligned": (
        lambda: memmap(with_value("observation", lambda x: x.roll(1, 0))),
        "is misaligned",
    ),
    "memmap: done of its own": (
        lambda: memmap(with_value(("next", "done"), torch.logical_not)),
        "next.done that is not terminated or truncated",
    ),
    "memmap: episodes with gaps": (
        lambda: memmap(lambda data: data.set("episode", torch.tensor([0, 0, 0, 2, 2]))),
        "episode 2 out of order at index 3",
    ),
    "memmap: wrong type": (
        lambda: memmap(with_value("observation", lambda x: x.half())),
        "not a plain tensor",
    ),
    "memmap: truncated file": (
        lambda: memmap(then=lambda folder: cut_short(folder / "action.memmap")),
        "has 10 bytes instead of 20",
    ),
    "memmap: a stray file": (
        lambda: memmap(then=stray),
        "holds 'other.pickle'",
    ),
    "memmap: an object": (
        lambda: memmap(lambda data: TensorDict({"x": "text"}, [])),
        "holds 'x', which is not a plain tensor",
    ),
    "memmap: a path": (meta(**{"../../secret": STRAY}), "which is not a plain tensor"),
    "memmap: another class": (meta(_type="os.system"), "something other than a TensorDict"),
    "memmap: a link": (lambda: memmap(then=link), "has links in it"),
    "memmap: a demonstration": (
        lambda: memmap(then=lambda f: (f / "card.json").write_text("{}")),
        "is a demonstration already: demo.path=folder takes it",
    ),
}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("case", CASES)
def test_each_fault_is_one_sentence(case, capsys):
    write, sentence = CASES[case]
    source = write()
    line = refused(capsys, "demo", "import", source, "--env-id", datasets.ENV, "--out", "a/demo")
    assert sentence in line
    assert not Path("mark").exists()


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (("import", "set.npz", "--out", "x"), "give either --task NAME or --env-id ID"),
        (("import", "set.npz", "--task", "a", "--env-id", "b", "--out", "x"), "give either"),
        (("import", "set.npz", "--task", "brekout", "--out", "x"), "did you mean 'breakout'"),
        (("import", "set.npz", "--env-id", "None-v9", "--out", "x"), "is not a Gymnasium id"),
        (("import", "set.npz", "--env-id", datasets.ENV), "required: --out"),
        (
            ("import", "set.npz", "--env-id", datasets.ENV, "--out", "x", "--episodes", "0"),
            "--episodes 0: at least 1 is needed",
        ),
        (("import", "x", "--env-id", datasets.ENV, "--out", "full"), "full is there already"),
        (
            ("import", "set.npz", "--env-id", datasets.ENV, "--out", "set.npz/demo"),
            "could not be read or written",
        ),
        (("export", "none", "--npz", "a.npz"), "is not the folder of a demonstration"),
        (("export", "demo"), "one of the arguments --minari --npz is required"),
        (("export", "demo", "--npz", "a.txt"), "does not end in .npz"),
        (("export", "demo", "--npz", "set.npz"), "set.npz is there already"),
        (("export", "demo", "--npz", "no/a.npz"), "there is no folder no"),
        (("export", "demo", "--minari", "../x-v0"), "is not the id of a Minari dataset"),
        (("export", "nameless", "--minari", "x-v0"), "give --task NAME or --env-id ID"),
    ],
)
def test_wrong_words_are_one_sentence(argv, sentence, capsys):
    from giril_rl.demos import Demonstration, named_task
    from giril_rl.demos.importing import import_demonstration

    demo = import_demonstration(columns(), named_task(None, datasets.ENV))
    demo.save("demo")
    Demonstration(demo.transitions, {}).save("nameless")
    Path("full").mkdir()
    Path("full/file").touch()
    assert sentence in refused(capsys, "demo", *argv)


def test_an_environment_named_by_a_dataset_is_never_made(capsys):
    """Minari's own reader would import what ``entry_point`` says."""
    Path("evil_module.py").write_text("import pathlib; pathlib.Path('mark').touch()")
    spec = {"id": "Evil-v0", "entry_point": "evil_module:Env"}
    source = minari(env_spec=json.dumps(spec))
    argv = ["demo", "import", source, "--env-id", datasets.ENV, "--out", "demo"]
    assert main(argv) == 0
    assert not Path("mark").exists() and Path("demo/card.json").is_file()
