"""A run is a folder: resolved config, versions, metrics as they come, checkpoints, the result."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import yaml
from filelock import FileLock, Timeout

from giril_rl.config.knobs import flat
from giril_rl.errors import UserError, told
from giril_rl.files.checkpoint import load_state, save_state
from giril_rl.files.disk import (
    installed_versions,
    missing,
    name_file,
    read_json,
    remove_empty,
    write_atomically,
    write_json,
)
from giril_rl.files.formats import RUN_FORMAT, check_run_format
from giril_rl.files.places import cannot_write, check_place
from giril_rl.files.untrusted import parse_yaml, read_text
from giril_rl.runs.metrics import METRICS, MetricsFile, check_logger, end_logger, make_logger
from giril_rl.runs.naming import NO_EFFECT, without_added
from giril_rl.runs.sources import sources_of

FIRST_FILES = ("config.yaml", "versions.json")
"""What a run's folder holds before its first part has come to anything."""
Closable = TypeVar("Closable")


class Run:
    """One run's folder, held by one process at a time; made and continued with :meth:`open`.

    ========================  ====================================================================
    ``config.yaml``           the resolved configuration, with the recipe's name
    ``versions.json``         the format of the folder, Python and the packages that decide the
                              numbers, and digests of the user's own code, see
                              :mod:`giril_rl.runs.sources`
    ``metrics.jsonl``         measurements, one JSON object a line
    ``NAME.safetensors``      checkpoints, see :func:`giril_rl.files.checkpoint.save_state`
    ``result.json``           written last; where it is, the run is finished
    ========================  ====================================================================

    Attributes:
        folder: the folder.
        recipe: the recipe's name.
        config: the resolved configuration, as given.
        versions: what ``versions.json`` holds.
        fit_seconds: what fitting reward models took, earlier processes included.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp()) / "run"
        >>> with Run.open(folder, {"seed": 0, "ppo": {"lr": 0.1}}, recipe="giril") as run:
        ...     state = run.load("ppo") or {"step": 0}
        ...     run.log(state["step"] + 512, {"ppo/loss": 0.5}, phase="ppo")
        ...     run.save("ppo", {"step": 512})
        >>> with Run.open(folder, {"seed": 0, "ppo": {"lr": 0.1}}, recipe="giril") as run:
        ...     print(run.load("ppo"), run.result)
        {'step': 512} None
        >>> Run.open(folder, {"seed": 0, "ppo": {"lr": 0.2}}, recipe="giril")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: ... was made with other settings (ppo.lr: 0.1 there, 0.2 now)...
    """

    def __init__(self, folder: Path, config: dict[str, Any], recipe: str, logger: str | None):
        self.folder, self.config, self.recipe = folder, config, recipe
        self.versions: dict[str, Any] = installed_versions()
        self.fit_seconds = 0.0
        self._logger_name = logger
        self._logger: Any = None
        self._metrics: MetricsFile
        self._lock = FileLock(str(folder / ".lock"), thread_local=False)
        self._open_parts = contextlib.ExitStack()
        self._new = not (folder / "config.yaml").exists()
        self._made = missing(folder)

    @classmethod
    def open(
        cls,
        folder: Path | str,
        config: dict[str, Any],
        *,
        recipe: str,
        logger: str | None = None,
        ignore: Collection[str] = NO_EFFECT,
    ) -> Run:
        """Make a run's folder, or open it again to continue; use the result in a ``with``.

        Args:
            folder: the folder, made if need be.
            config: the resolved configuration, of plain dicts, lists and scalars.
            recipe: the recipe's name, which belongs to the configuration.
            logger: "tensorboard", "csv", "wandb" or "mlflow", beside ``metrics.jsonl``.
            ignore: dotted keys that may differ from the ones that the run was made with.

        Raises:
            UserError: if the folder holds something else, was made with other settings or is in
                use, or if the logger is unknown or not installed.
        """
        check_logger(logger)
        check_place(Path(folder), "out=")
        run = cls(Path(folder), config, recipe, logger)
        run._refuse_foreign_folder()
        check_run_format(run.folder, [RUN_FORMAT])
        try:
            run.folder.mkdir(parents=True, exist_ok=True)
            run._lock.acquire(blocking=False)
        except Timeout:
            raise UserError(
                f"{run.folder} is in use by another process: wait for it to end, "
                "or choose another out=."
            ) from None
        except OSError as error:
            if told(error) is not error:  # A disk that failed is no bad choice of a place.
                raise
            raise cannot_write(run.folder, "out=", error) from None
        try:
            for leftover in run.folder.glob(".*.tmp"):
                leftover.unlink()
            run._compare_config(ignore)
            run._check_checkpoints()
            run._write_config()
            run._write_versions()
            run._metrics = MetricsFile(run.folder / METRICS)
        except BaseException as error:
            run.close(error)
            raise
        return run

    def closing(self, part: Closable) -> Closable:
        """``part`` itself, closed at the latest with the run, however that ends.

        Examples:
            >>> import tempfile
            >>> from giril_rl.config.schema import TaskConfig
            >>> from giril_rl.envs import make_env
            >>> task = TaskConfig(name="cartpole", env_id="CartPole-v1")
            >>> with Run.open(tempfile.mkdtemp(), {}, recipe="mine") as run:
            ...     env = run.closing(make_env(task, num_envs=1, seed=0))
            >>> env.is_closed
            True
        """
        self._open_parts.callback(_close, part)
        return part

    def log(self, step: int, values: Mapping[str, float], *, phase: str) -> None:
        """Append one row to ``metrics.jsonl``, and to the logger if there is one.

        Args:
            step: the phase's own count, such as environment steps; resuming goes by it.
            values: measurements, with their group in the key, such as ``"ppo/loss"``.
            phase: the part of the run, such as ``"fit"`` or ``"ppo"``.
        """
        self._metrics.write(phase, step, values)
        if self._logger_name is None:
            return
        try:
            if self._logger is None:
                self._logger = make_logger(self._logger_name, self.folder)  # type: ignore[arg-type]
            self._logger.log_metrics({key: float(value) for key, value in values.items()}, step)
        except OSError as error:
            name_file(error, self.folder)
            raise

    def truncate_metrics(self, phase: str, step: int) -> None:
        """Forget the rows of ``phase`` later than ``step``, before continuing from there.

        What a logger such as TensorBoard has already shown stays there.
        """
        self._metrics.truncate(phase, step)

    def save(self, name: str, state: dict[str, Any]) -> None:
        """Save the checkpoint ``name``, replacing its predecessor at once."""
        save_state(self.folder / f"{name}.safetensors", state)

    def load(self, name: str) -> dict[str, Any] | None:
        """The checkpoint ``name``, or None if there is none yet."""
        path = self.folder / f"{name}.safetensors"
        return load_state(path) if path.exists() else None

    @property
    def result(self) -> dict[str, Any] | None:
        """What :meth:`finish` wrote, or None while the run is not finished."""
        path = self.folder / "result.json"
        return read_json(path) if path.exists() else None

    @property
    def finished(self) -> bool:
        """Whether the run has a result."""
        return (self.folder / "result.json").exists()

    def finish(self, result: dict[str, Any]) -> None:
        """Write ``result.json``, which marks the run as finished."""
        write_json(self.folder / "result.json", result)

    def close(self, error: BaseException | None = None) -> None:
        """End the logger's run and let another process have the folder.

        A run that was refused before anything came of it leaves no folder.

        Args:
            error: why the run ended before its time, if it did.
        """
        logger, self._logger = self._logger, None
        try:
            self._open_parts.close()
            if logger is not None:
                end_logger(logger, error)
        finally:
            held = {path.name for path in self.folder.glob("*")}
            refused = isinstance(error, UserError) and self._new and held <= {*FIRST_FILES, ".lock"}
            if refused:
                for name in FIRST_FILES:
                    (self.folder / name).unlink(missing_ok=True)
            self._lock.release()
            if refused:
                (self.folder / ".lock").unlink(missing_ok=True)
                remove_empty(self._made)

    def __enter__(self) -> Run:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close(error)

    def _refuse_foreign_folder(self) -> None:
        if not self.folder.exists() or (self.folder / "config.yaml").exists():
            return
        others = sorted(
            path.name
            for path in self.folder.iterdir()
            if path.name != ".lock" and not path.match(".*.tmp")
        )
        if others:
            raise UserError(
                f"{self.folder} is not a run's folder and is not empty (it holds {others[0]}): "
                "choose another out=."
            )

    def _written_config(self) -> dict[str, Any]:
        # Through JSON, so that tuples and lists compare equal, as they do once written.
        return json.loads(json.dumps({"recipe": self.recipe, **self.config}))

    def _compare_config(self, ignore: Collection[str]) -> None:
        path = self.folder / "config.yaml"
        if not path.exists():
            return
        try:
            before = parse_yaml(read_text(path))
        except (OSError, ValueError, yaml.YAMLError):
            before = None
        if not isinstance(before, dict):
            raise UserError(f"{path} cannot be read: choose another out=, or delete the folder.")
        differences = _differences(before, self._written_config(), ignore)
        if differences:
            more = f" and {len(differences) - 3} more" if len(differences) > 3 else ""
            raise UserError(
                f"{self.folder} was made with other settings ({'; '.join(differences[:3])}{more}): "
                "choose another out=, or delete the folder."
            )

    def _write_config(self) -> None:
        """An unfinished run goes on with the settings of now, where they may differ."""
        path = self.folder / "config.yaml"
        config = self._written_config()
        if path.exists():
            before = flat(parse_yaml(read_text(path)), keep_empty=True)
            now = flat(config, keep_empty=True)
            if self.finished or all(before.get(key, now[key]) == now[key] for key in now):
                return
        write_atomically(path, yaml.safe_dump(config, sort_keys=False))

    def _check_checkpoints(self) -> None:
        """A damaged one is refused now, not when its part's turn has come."""
        if not self.finished:
            for path in sorted(self.folder.glob("*.safetensors")):
                load_state(path)

    def _write_versions(self) -> None:
        path = self.folder / "versions.json"
        if self.finished and path.exists():
            return  # What is only looked at was not made with these versions.
        before = read_json(path) if path.exists() else self.versions
        known = before.get("sources")
        sources = {**(known if isinstance(known, dict) else {}), **sources_of(self.folder)}
        for name, now in self.versions.items():
            if before.get(name) != now:
                warnings.warn(
                    f"{self.folder} was begun with {name} {before.get(name)} and continues with "
                    f"{now}: its numbers may not repeat.",
                    stacklevel=4,
                )
        content = {"format_version": RUN_FORMAT, **self.versions}
        write_json(path, {**content, "sources": sources} if sources else content)


def _close(part: Any) -> None:
    if not getattr(part, "is_closed", False):  # An environment of TorchRL's, closed by a collector.
        part.close()


def _differences(
    before: Mapping[str, Any], now: Mapping[str, Any], ignore: Collection[str]
) -> list[str]:
    """``"ppo.lr: 0.1 there, 0.2 now"`` for each dotted key whose values differ."""
    old, new = (flat(without_added(config), keep_empty=True) for config in (before, now))
    return [
        f"{key}: {old.get(key, 'nothing')!s} there, {new.get(key, 'nothing')!s} now"
        for key in [*new, *(key for key in old if key not in new)]
        if not any(key == name or key.startswith(f"{name}.") for name in ignore)
        and (key not in old or key not in new or old[key] != new[key])
    ]
