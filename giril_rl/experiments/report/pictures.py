"""Pictures of what generative rewards of Atari runs do, as a report's sections."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from giril_rl.config.schema import DemoConfig
from giril_rl.demos import Demonstration
from giril_rl.errors import UserError
from giril_rl.experiments.report.game import GAMES, MOST_STEPS, typical_game
from giril_rl.experiments.report.game_reward import draw_game, rewards_of
from giril_rl.experiments.report.predictions import Shown, draw_predictions, foresee, spread
from giril_rl.experiments.report.rows import Panel, Row
from giril_rl.experiments.report.runs import RunRecord
from giril_rl.experiments.report.style import is_own
from giril_rl.files.disk import read_json
from giril_rl.policies import load_agent
from giril_rl.rewards import GenerativeReward
from giril_rl.runs.finished import read_config, read_part, read_settings
from giril_rl.runs.identity import safe
from giril_rl.runs.pretrained import CARD
from giril_rl.training.demonstrations import find_demonstration
from giril_rl.training.result import REWARD

UNTRAINED = "control:untrained_giril"
GENERATIVE = frozenset({"giril", UNTRAINED})
"""Methods, as results name them, whose reward is a generative model's error."""
EACH = 4
"""Transitions of the demonstration, and of the policy."""
MOST_STEPS_LITERAL = 300
"""Steps of a game where beta < 1: the reward then takes the whole networks for each."""


def draw_pictures(panels: Sequence[Panel], out: Path) -> list[str]:
    """Draw predictions and a game's reward for a run of each row of generative rewards on Atari.

    A row's run is the one with the lowest seed. Nothing is trained or recorded: a run that lacks a
    file is named with the reason, and one without its demonstration has pictures of its policy.

    Args:
        panels: all rows, by task; tasks of vectors have no pictures.
        out: folder of the PNG files.

    Returns:
        A section of Markdown for each Atari task with such runs.
    """
    sections = []
    for panel in panels:
        rows = [row for row in panel.rows if _is_game(row) and _is_generative(row)]
        if rows:
            sections.append(_section(panel, rows, out))
    return sections


def _is_game(row: Row) -> bool:
    family = row.runs[0].family
    return family.has_lives and family.observation == "image"


def _is_generative(row: Row) -> bool:
    """Whether the reward is a generative model's error; of a user's own recipe, its card tells."""
    card = row.runs[0].folder / REWARD / CARD
    if not is_own(row.method) or not card.is_file():
        return row.method in GENERATIVE
    try:
        made_by = read_json(card).get("made_by")
    except UserError:
        return True  # Where it is loaded, it is said what is wrong with it.
    return isinstance(made_by, dict) and made_by.get("class") == GenerativeReward.__name__


def _section(panel: Panel, rows: Sequence[Row], out: Path) -> str:
    text, missing = [], defaultdict(list)
    for row in rows:
        run = row.runs[0]
        try:
            text.append(_pictures(panel, row, run, out))
        except UserError as error:
            reason = str(error).replace(f"{run.folder}/", "its ").replace(str(run.folder), "it")
            missing[reason].append(run.name)
    if text:
        text.insert(0, _EXPLAINED)
    for reason, names in missing.items():
        text.append(f"No pictures of {', '.join(f'`{name}`' for name in names)}: {reason}\n")
    return "\n".join([f"## {panel.title}: pictures\n", *text])


_EXPLAINED = (
    "Of each row above, the run with the lowest seed. Predictions: the last of the four frames of "
    "s, of the s' that the model foresees and of the true s', and the squared error of that frame; "
    "the reward is of all four frames, as the module has it before any averaging and scaling. "
    "Transitions are evenly spread in time. Along a game: the same reward, step by step, and "
    "dashed its mean over the demonstration; below, without the steps that begin a life, while "
    "the stack is not yet full of frames. The policy samples its actions; of "
    f"{GAMES} games the one of median score is shown. The picture ends "
    f"after {MOST_STEPS:,} steps, where beta is below 1 after {MOST_STEPS_LITERAL:,}.\n"
)


def _pictures(panel: Panel, row: Row, run: RunRecord, out: Path) -> str:
    """Draws a run's two pictures; their Markdown."""
    task, scoring = read_settings(run.folder)
    model = GenerativeReward.from_pretrained(run.folder / REWARD)
    demo = find_demonstration(run.folder, run.below)
    most = MOST_STEPS if model.beta == 1 else MOST_STEPS_LITERAL
    agent = load_agent(run.folder, task)
    game, seed = typical_game(agent, task, seed=scoring.seed, most=most)
    length = f"{len(game.lives):,} steps"
    played = f"a whole game of {length}" if game.whole else f"the first {length} of a game"

    indices = spread(len(game.lives), EACH)
    policy = foresee(
        model,
        game.transitions[indices],
        title=f"trained policy, {played}",
        labels=[f"step {index + 1:,}" for index in indices],
        actions=game.actions,
    )
    groups, usual = [policy], None
    if demo is not None:
        groups.insert(0, _foresee_demonstration(run, demo, model, game.actions))
        usual = rewards_of(model, demo.transitions[spread(len(demo), most)]).mean().item()
    name = safe("-".join(filter(None, (*_names(panel, row), f"{run.steps}", f"seed{run.seed}"))))
    about = f"{row.name}, seed {run.seed}, {run.steps:,} steps"
    title = f"{panel.title}: {about}"
    draw_predictions(groups, title, out / f"predictions-{name}.png")
    draw_game(rewards_of(model, game.transitions), game, title, out / f"reward-{name}.png", usual)
    settings = f" `{row.settings}`" if row.settings else ""
    without = "" if demo is not None else f" {_NO_DEMONSTRATION}"
    return (
        f"{about}{settings}: `{run.name}`; {played}, seed {seed}.{without}\n\n"
        f"![predictions, {about}](predictions-{name}.png)\n\n"
        f"![reward along a game, {about}](reward-{name}.png)\n"
    )


_NO_DEMONSTRATION = (
    "Its demonstration is not in the folder reported on, so all transitions are the policy's."
)


def _names(panel: Panel, row: Row) -> tuple[str, ...]:
    settings = row.settings.replace(" ", ",")
    return panel.title.replace(", ", "-"), row.method, row.profile or "", settings


def _foresee_demonstration(
    run: RunRecord,
    demo: Demonstration,
    model: GenerativeReward,
    actions: Sequence[str],
) -> Shown:
    indices = spread(len(demo), EACH)
    some = demo.transitions[indices]
    labels = [f"step {step + 1:,}" for step in some["step"].tolist()]
    if demo.num_episodes > 1:
        episodes = some["episode"].tolist()
        labels = [f"game {e + 1}\n{label}" for e, label in zip(episodes, labels, strict=True)]
    title = f"demonstration, {len(demo):,} transitions"
    every = read_part(run.folder, read_config(run.folder), "demo", DemoConfig).subsample
    if run.method != UNTRAINED and every > 1:
        title += f", of which the model was fitted to 1 in {every}"
        labels = [
            f"{label}\n{'not ' if index % every else ''}fitted"
            for index, label in zip(indices, labels, strict=True)
        ]
    return foresee(model, some, title=title, labels=labels, actions=actions)
