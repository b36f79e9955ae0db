"""What a demonstration holds, as text."""

from __future__ import annotations

from giril_rl.demos.demonstration import Demonstration

_LIVES = {"first": ", each up to the first lost life", "all": ", each through all lives"}
_PLAYED = {"True": "deterministic", "False": "sampled", "by hand": "by hand"}


def describe(demo: Demonstration) -> str:
    """A table of a demonstration: where it comes from, what was done, how each episode went.

    Args:
        demo: what to look at; its card may lack anything.

    Examples:
        >>> import gymnasium
        >>> from giril_rl.demos import record_demonstration
        >>> demo = record_demonstration(
        ...     lambda: gymnasium.make("CartPole-v1"), lambda o: o.new_ones(1).long(),
        ...     length=15, seed=0, task="cartpole", expert={"return_mean": 9.5, "seed": 1},
        ... )
        >>> demo.card["processor"] = "of this example"
        >>> print(describe(demo))
        task         cartpole (CartPole-v1)
        id           ...
        transitions  15
        episodes     2
        observation  4 numbers
        actions      1: 15 (100%)
        played       deterministic, seed 0
        expert       return 9.5, seed 1
        processor    of this example
        <BLANKLINE>
        episode  length  score  end
              0      10   10.0  terminated
              1       5    5.0  cut
    """
    card = demo.card
    lives = str(card.get("lives"))
    shape = list(demo.transitions["observation"].shape[1:])
    images = f"images {' x '.join(map(str, shape))}"
    played = _PLAYED.get(str(card.get("deterministic")), "not known how")
    rows = {
        "task": f"{card.get('task')} ({card.get('env_id')})",
        "id": demo.demo_id,
        "transitions": f"{len(demo):,}",
        "episodes": f"{demo.num_episodes:,}{_LIVES.get(lives, '')}",
        "observation": images if demo.has_images else _numbers(shape[0]),
        "actions": _actions(demo),
        "played": f"{played}, seed {card.get('seed')}",
        "expert": _expert(card.get("expert")),
    }
    if isinstance(card.get("processor"), str):
        rows["processor"] = card["processor"]
    source = card.get("source")
    if isinstance(source, dict):
        rows["source"] = f"{source.get('name')} ({source.get('format')})"
        rows["replay"] = str(card.get("replay"))
    width = max(map(len, rows)) + 2
    lines = [f"{name:<{width}}{value}" for name, value in rows.items()]
    return "\n".join([*lines, "", *_episodes(demo)])


def _numbers(count: int) -> str:
    return "1 number" if count == 1 else f"{count} numbers"


def _actions(demo: Demonstration) -> str:
    action, names = demo.transitions["action"], demo.card.get("actions")
    if action.ndim > 1:
        return f"{_numbers(action.shape[1])} from {action.min():.2f} to {action.max():.2f}"
    values, counts = action.unique(return_counts=True)
    parts = []
    for value, count in zip(values.tolist(), counts.tolist(), strict=True):
        name = names[value] if isinstance(names, list) and value < len(names) else value
        parts.append(f"{name}: {count:,} ({count / len(demo):.0%})")
    return ", ".join(parts)


def _expert(expert: object) -> str:
    if not isinstance(expert, dict) or not isinstance(expert.get("return_mean"), int | float):
        return "not known"
    steps = expert.get("env_steps")
    trained = f", {steps:,} steps" if isinstance(steps, int) else ""
    return f"return {expert['return_mean']:,.1f}, seed {expert.get('seed')}{trained}"


def _episodes(demo: Demonstration) -> list[str]:
    after = demo.transitions["next"]
    last = (demo.lengths.cumsum(0) - 1).tolist()
    lives = _lives_left(demo)
    rows = [["episode", "length", "score", *(["lives"] if lives else []), "end"]]
    parts = zip(demo.lengths.tolist(), demo.returns.tolist(), last, strict=True)
    for number, (length, score, row) in enumerate(parts):
        if after["terminated"][row]:
            end = _ended(demo, lives[number] if lives else None)
        else:
            end = "time limit" if after["truncated"][row] else "cut"
        shown = f"{score:,.1f}" if demo.has_rewards else "unknown"
        left = ["{} -> {}".format(*lives[number])] if lives else []
        rows.append([str(number), f"{length:,}", shown, *left, end])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    return [
        "  ".join([*(f"{x:>{w}}" for x, w in zip(row[:-1], widths, strict=True)), row[-1]])
        for row in rows
    ]


def _lives_left(demo: Demonstration) -> list[list[int]] | None:
    """Lives at each episode's beginning and end, if the card has them; it may lie."""
    found = demo.card.get("lives_left")
    if not isinstance(found, list) or len(found) != demo.num_episodes:
        return None
    pairs = (
        isinstance(pair, list) and len(pair) == 2 and all(isinstance(n, int) for n in pair)
        for pair in found
    )
    return found if all(pairs) else None


def _ended(demo: Demonstration, lives: list[int] | None) -> str:
    """Some games have no lives, and their first is as long as the game."""
    kind = demo.card.get("lives")
    if kind not in ("first", "all"):
        return "terminated"
    if lives is not None:
        return "life lost" if kind == "first" and lives[1] > 0 else "game over"
    return "life lost" if kind == "first" else "game over"
