"""Other people's data sets as demonstrations."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from giril_rl.config.schema import TaskConfig
from giril_rl.demos.arrays import check_names, needed, to_transitions
from giril_rl.demos.check import check_for_task
from giril_rl.demos.demonstration import Demonstration
from giril_rl.demos.minari import read_minari
from giril_rl.demos.npz import read_npz
from giril_rl.demos.replay import verify_by_replay
from giril_rl.demos.storage import load_tensors
from giril_rl.envs import as_recorded_task, gym_factory
from giril_rl.errors import UserError
from giril_rl.runs.machine import installed_versions

MINARI = "minari:"
_DTYPES = ("float32", "float64", "uint8", "int8", "int16", "int32", "int64", "bool")
_NEEDED = ("observation", "action", "next.observation", "next.terminated", "next.truncated")


def import_demonstration(
    source: str,
    task: TaskConfig,
    *,
    episodes: int | None = None,
    name: str | None = None,
    actions: bool = True,
) -> Demonstration:
    """Reads a data set and checks it against a task; :meth:`Demonstration.save` then writes it.

    Only a replay can prove that actions belong to their states. It needs the episodes' seeds and
    rewards. Where the data set has both, it is tried; the card's ``replay`` says "same bits", what
    differed, or why there was none. The card's ``rewards`` says whether they are known.

    Args:
        source: ``minari:NAME``, a local dataset; an ``.npz`` file, see
            :func:`~giril_rl.demos.npz.read_npz`; or the folder of a TensorDict memmap with
            ``observation``, ``action`` and ``("next", "observation" | "terminated" |
            "truncated")``, batch [N].
        task: the demonstrated task.
        episodes: number of episodes to take, from the first; None takes all.
        name: what the card calls the source; its file's name if None.
        actions: False takes states alone, whether or not the data set has actions.

    Raises:
        UserError: if the data set has a fault or does not fit the task.

    Examples:
        >>> import tempfile
        >>> from giril_rl.demos import record_demonstration, to_npz
        >>> cartpole = TaskConfig(name="cartpole", env_id="CartPole-v1")
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
            columns, untrusted = read_minari(own, episodes, actions=actions)
        elif path.is_dir():
            kind, own = "memmap", path.resolve().name
            columns, untrusted = _read_memmap(path, actions), {}
        elif path.suffix == ".npz":
            kind, own = "npz", path.name
            columns, untrusted = read_npz(path, actions=actions)
        else:
            raise UserError(
                f"{source} is neither minari:NAME, nor an .npz file, nor a folder of a TensorDict: "
                "name one of these."
            )
        demo = Demonstration(to_transitions(columns, actions=actions))
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
    if not actions:
        demo.card["actions"] = False
    check_for_task(demo, task)
    demo.card["episode_returns"] = demo.returns.tolist() if rewards else None
    demo.card["replay"] = _replayed(demo, task)
    return demo


def _read_memmap(folder: Path, actions: bool) -> dict[str, np.ndarray]:
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
    names = [
        key if isinstance(key, str) else ".".join(key) for key in data.keys(True, leaves_only=True)
    ]
    check_names(names, needed(_NEEDED, actions=actions), f"{folder} has no")
    after = data["next"]
    found = {name: data.get(name, None) for name in ("observation", "action", "episode", "step")}
    found |= {name: after.get(name, None) for name in ("reward", "terminated", "truncated")}
    found["next_observation"] = after["observation"]
    columns = {name: value.numpy() for name, value in found.items() if value is not None}
    done = np.logical_or(columns["terminated"], columns["truncated"])
    if "done" in after and not np.array_equal(after["done"].numpy(), done):
        raise UserError(f"{folder} has next.done that is not terminated or truncated: mend it.")
    return columns


def _believed(card: dict[str, Any], demo: Demonstration) -> dict[str, Any]:
    """The values of an untrusted card that have the right form."""

    def number(value: Any) -> Any:
        return value if type(value) is int and 0 <= value < 2**63 else None

    count, seeds, expert = demo.num_episodes, card.get("seeds"), card.get("expert")
    played = card.get("deterministic")
    seeds = seeds[:count] if isinstance(seeds, list) else []
    known = len(seeds) == count and all(number(seed) is not None for seed in seeds)
    whole = bool(demo.transitions["next", "done"][-1])
    cut = not whole and number(card.get("length")) is not None
    believed: dict[str, Any] = {
        "seed": number(card.get("seed")),
        "seeds": seeds if known else [],
        "length": len(demo) if cut else None,
        "deterministic": played if isinstance(played, bool) or played == "by hand" else None,
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


def _printable(text: str) -> str:
    """``text`` without control characters, which could tell a terminal anything."""
    return "".join(letter for letter in text if letter.isprintable())[:100]


def _replayed(demo: Demonstration, task: TaskConfig) -> str:
    if not demo.has_actions:
        return "none: no actions"
    if not demo.card["seeds"]:
        return "none: no seeds"
    if not demo.has_rewards:
        return "none: no rewards"
    try:
        verify_by_replay(demo, gym_factory(as_recorded_task(task, demo.card.get("lives"))))
    except UserError as error:
        return f"differs: {error}"
    return "same bits"
