"""The task that a demonstration is of, by the name that a recipe takes or by a Gymnasium id."""

from __future__ import annotations

from omegaconf import OmegaConf

from giril_rl.config.nearest import did_you_mean
from giril_rl.config.recipe_files import shipped_conf
from giril_rl.config.schema import TaskConfig
from giril_rl.errors import UserError

_OPEN = ("atari", "gymnasium")  # These are completed by an id.


def named_task(name: str | None, env_id: str | None, title: str | None = None) -> TaskConfig:
    """The task ``name`` of the shipped ones, or that of a Gymnasium id.

    Args:
        name: as in ``task=breakout``.
        env_id: as in ``task.env_id=Pendulum-v1``, instead of ``name``.
        title: what tables call the task of an id; the id itself if None.

    Raises:
        UserError: unless exactly one of ``name`` and ``env_id`` is given, or for an unknown name.

    Examples:
        >>> named_task("breakout", None).env_id, named_task(None, "Pendulum-v1").name
        ('ALE/Breakout-v5', 'Pendulum-v1')
    """
    if (name is None) == (env_id is None):
        raise UserError("say which task it is of: give either --task NAME or --env-id ID.")
    if env_id is not None:
        return TaskConfig(name=title or env_id, env_id=env_id)
    files = {file.stem: file for file in (shipped_conf() / "task").glob("*.yaml")}
    files = {stem: file for stem, file in files.items() if stem not in _OPEN}
    if name not in files:
        hint = did_you_mean(str(name), files) or f": choose one of {', '.join(sorted(files))}."
        raise UserError(f"--task {name} is not a task{hint}")
    built = OmegaConf.to_object(
        OmegaConf.merge(OmegaConf.structured(TaskConfig), OmegaConf.load(files[name]))
    )
    assert isinstance(built, TaskConfig)
    return built
