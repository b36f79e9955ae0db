"""Someone else's data set as a demonstration."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from giril_rl.config.schema import TaskConfig
from giril_rl.demos.arrays import to_transitions
from giril_rl.demos.demonstration import Demonstration
from giril_rl.demos.minari_read import read_minari
from giril_rl.demos.names import check_names
from giril_rl.demos.npz import read_npz
from giril_rl.demos.replay import verify_by_replay
from giril_rl.demos.storage import load_tensors
from giril_rl.demos.task import as_recorded_task, check_for_task
from giril_rl.envs import gym_factory
from giril_rl.errors import UserError
from giril_rl.files.disk import installed_versions

MINARI = "minari:"
_DTYPES = ("float32", "float64", "uint8", "int8", "int16", "int32", "int64", "bool")
_NEEDED = ("observation", "action", "next.observation", "next.terminated", "next.truncated")
_NEXT = {"observation": "next_observation", "reward": "reward"}
_Read = tuple[dict[str, np.ndarray], dict[str, Any]]


def import_demonstration(
    source: str, task: TaskConfig, *, episodes: int | None = None, name: str | None = None
) -> Demonstration:
    """Read a data set and check it against a task; :meth:`Demonstration.save` then writes it.

    Actions can be proved to belong to their states only by a replay, which needs the episodes'
    seeds and rewards. Where the data set has both, it is tried; the card's ``replay`` says "same
    bits", what differed, or why there was none. The card's ``rewards`` says whether they are known.

    Args:
        source: ``minari:NAME``, a local dataset; an ``.npz`` file, see
            :func:`~giril_rl.demos.npz.read_npz`; or the folder of a TensorDict memmap with
            ``observation``, ``action`` and ``("next", "observation" | "terminated" |
            "truncated")``, batch [N].
        task: what it is a demonstration of.
        episodes: how many of it, the first ones; all if None.
        name: what the card calls the source; its file's name if None.

    Raises:
        UserError: in one sentence, for whatever is wrong with the data set or does not fit.

    Examples:
        >>> import tempfile
        >>> from giril_rl.demos import record_demonstration, to_npz
        >>> from giril_rl.demos import named_task
        >>> cartpole = named_task(None, "CartPole-v1")
        >>> demo = record_demonstration(
        ...     gym_factory(cartpole), lambda o: o.new_ones(1).long(), episodes=2, seed=0
        ... )
        >>> path = Path(tempfile.mkdtemp()) / "cartpole.npz"
        >>> to_npz(demo, path)
        >>> again = import_demonstration(str(path), cartpole)
        >>> bool((again.transitions == demo.transitions).all()), again.card["replay"]
        (True, 'same bits')
    """
    if episodes is not None and episodes < 1:
        raise UserError(f"--episodes {episodes}: at least 1 is needed.")
    path = Path(source)
    try:
        if source.startswith(MINARI):
            kind, own = "minari", source.removeprefix(MINARI)
            columns, untrusted = read_minari(own, episodes)
        elif path.is_dir():
            kind, own = "memmap", path.resolve().name
            columns, untrusted = _read_memmap(path), {}
        elif path.suffix == ".npz":
            kind, own = "npz", path.name
            columns, untrusted = read_npz(path)
        else:
            raise UserError(
                f"{source} is neither minari:NAME, nor an .npz file, nor a folder of a TensorDict: "
                "name one of these."
            )
        demo = Demonstration(to_transitions(columns))
    except MemoryError:
        raise UserError(f"{source} does not fit into memory: take fewer episodes.") from None
    if episodes is not None:
        if demo.num_episodes < episodes:
            raise UserError(
                f"--episodes {episodes}: {own} has only {demo.num_episodes}, give at most that."
            )
        demo.transitions = demo.transitions[demo.transitions["episode"] < episodes]
    rewards = "reward" in columns
    demo.card = {
        "task": task.name,
        "env_id": task.env_id,
        **_believed(untrusted, demo),
        "versions": installed_versions(),
        "transitions": len(demo),
        "rewards": rewards,
        "source": {"format": kind, "name": _printable(name or own)},
    }
    check_for_task(demo, task)
    demo.card["episode_returns"] = demo.returns.tolist() if rewards else None
    demo.card["replay"] = _replayed(demo, task)
    return demo


def _read_memmap(folder: Path) -> dict[str, np.ndarray]:
    if (folder / "card.json").is_file():
        raise UserError(f"{folder} is a demonstration already: demo.path={folder} takes it.")
    if any(path.is_symlink() for path in folder.rglob("*")):
        raise UserError(f"{folder} has links in it: copy the files themselves there.")
    if not (folder / "meta.json").is_file():
        raise UserError(f"{folder} is not the folder of a TensorDict memmap (no meta.json).")
    data = load_tensors(folder, _DTYPES)
    if data.ndim != 1:
        raise UserError(
            f"{folder} has the batch shape {list(data.shape)}: flatten it to [N] transitions, "
            "episode after episode."
        )
    found = [
        key if isinstance(key, str) else ".".join(key) for key in data.keys(True, leaves_only=True)
    ]
    check_names(found, _NEEDED, f"{folder} has no")
    keys: dict[str, Any] = {name: name for name in ("observation", "action", "episode", "step")}
    keys |= {_NEXT.get(name, name): ("next", name) for name in (*_NEXT, "terminated", "truncated")}
    columns = {
        name: value.numpy()
        for name, key in keys.items()
        if (value := data.get(key, None)) is not None
    }
    done = data.get(("next", "done"), None)
    ends = [columns[name] for name in ("terminated", "truncated") if name in columns]
    if done is not None and len(ends) == 2 and not np.array_equal(done.numpy(), ends[0] | ends[1]):
        raise UserError(f"{folder} has next.done that is not terminated or truncated: mend it.")
    return columns


def _believed(card: dict[str, Any], demo: Demonstration) -> dict[str, Any]:
    """Those values of a card that anyone may have written which have the form they should."""

    def number(value: Any) -> Any:
        return value if type(value) is int and 0 <= value < 2**63 else None

    count, seeds, expert = demo.num_episodes, card.get("seeds"), card.get("expert")
    seeds = seeds[:count] if isinstance(seeds, list) else []
    known = len(seeds) == count and all(number(seed) is not None for seed in seeds)
    whole = bool(demo.transitions["next", "done"][-1])
    cut = not whole and number(card.get("length")) is not None
    believed: dict[str, Any] = {
        "seed": number(card.get("seed")),
        "seeds": seeds if known else [],
        "length": len(demo) if cut else None,
        "deterministic": card.get("deterministic") if _plain(card.get("deterministic")) else None,
        "expert": None,
    }
    if isinstance(expert, dict):
        mean = expert.get("return_mean")
        if isinstance(mean, int | float) and abs(mean) < 1e15 and math.isfinite(mean):
            believed["expert"] = {"return_mean": mean, "seed": number(expert.get("seed"))}
    if card.get("lives") in ("first", "all"):
        believed["lives"] = card["lives"]
    names = card.get("actions")
    if isinstance(names, list) and all(isinstance(one, str) for one in names[:100]):
        believed["actions"] = [_printable(one) for one in names[:100]]
    return believed


def _plain(value: Any) -> bool:
    return isinstance(value, bool) or value == "by hand"


def _printable(text: str) -> str:
    """A terminal may be told anything by a text with control characters."""
    return "".join(letter for letter in text if letter.isprintable())[:100]


def _replayed(demo: Demonstration, task: TaskConfig) -> str:
    if not demo.card["seeds"]:
        return "none: no seeds"
    if not demo.has_rewards:
        return "none: no rewards"
    try:
        verify_by_replay(demo, gym_factory(as_recorded_task(task, demo.card.get("lives"))))
    except UserError as error:
        return f"differs: {error}"
    return "same bits"
