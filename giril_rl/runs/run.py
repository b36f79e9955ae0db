"""A run is a folder: config, versions, metrics, checkpoints and, in the end, the result."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from filelock import FileLock, Timeout

from giril_rl.config.knobs import flat
from giril_rl.errors import UserError, told
from giril_rl.files.disk import (
    cannot_write,
    check_place,
    missing,
    name_file,
    read_json,
    remove_empty,
    write_atomically,
    write_json,
)
from giril_rl.files.untrusted import parse_yaml, read_text
from giril_rl.runs.checkpoint import load_state, save_state
from giril_rl.runs.finished import RUN_FORMAT, check_run_format
from giril_rl.runs.identity import NO_EFFECT, differences, sources_of
from giril_rl.runs.loggers import check_logger, end_logger, make_logger
from giril_rl.runs.machine import installed_versions
from giril_rl.runs.metrics import METRICS, MetricsFile

FIRST_FILES = ("config.yaml", "versions.json")
"""The files of a run's folder before anything was learned."""
Closable = TypeVar("Closable")


class Run:
    """One run's folder, used by one process at a time; :meth:`open` makes or continues it.

    ========================  ====================================================================
    ``config.yaml``           the resolved settings and the recipe's name
    ``versions.json``         the folder's format, the versions of Python and of the packages that
                              decide the numbers, and digests of the user's own code, see
                              :func:`giril_rl.runs.identity.sources`
    ``metrics.jsonl``         measurements, one JSON object a line
    ``NAME.safetensors``      checkpoints, see :mod:`giril_rl.runs.checkpoint`
    ``result.json``           written last: a run that has it is finished
    ========================  ====================================================================

    Attributes:
        folder: the folder.
        recipe: the recipe's name.
        config: the resolved settings, as given.
        versions: versions of Python and of the packages that decide the numbers.
        fit_seconds: seconds of fitting before the policy learns, earlier processes included.

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
        """Make a run's folder, or open it to continue; use it in a ``with``.

        Args:
            folder: the folder, which may not exist yet.
            config: the resolved settings: plain dictionaries, lists and scalars.
            recipe: the recipe's name, saved with the settings.
            logger: "tensorboard", "csv", "wandb" or "mlflow", beside ``metrics.jsonl``.
            ignore: dotted keys whose values may differ from those the run was made with.

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
            if told(error) is not error:  # A failing disk is not a bad choice of out=.
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
        """``part`` itself, such as an environment, to be closed with the run, however that ends.

        Examples:
            >>> import tempfile
            >>> with Run.open(tempfile.mkdtemp(), {}, recipe="mine") as run:
            ...     file = run.closing(open(run.folder / "notes.txt", "w"))
            >>> file.closed
            True
        """
        self._open_parts.callback(_close, part)
        return part

    def log(self, step: int, values: Mapping[str, float], *, phase: str) -> None:
        """Append a row to ``metrics.jsonl``, and to the logger if there is one.

        Args:
            step: the phase's own count, such as environment steps.
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
        """Drop the rows of ``phase`` after ``step``, before continuing from there.

        Loggers such as TensorBoard keep what they have.
        """
        self._metrics.truncate(phase, step)

    def save(self, name: str, state: dict[str, Any]) -> None:
        """Save the checkpoint ``name``, replacing the previous one atomically."""
        save_state(self.folder / f"{name}.safetensors", state)

    def load(self, name: str) -> dict[str, Any] | None:
        """The checkpoint ``name``, or None if there is none."""
        path = self.folder / f"{name}.safetensors"
        return load_state(path) if path.exists() else None

    @property
    def result(self) -> dict[str, Any] | None:
        """What :meth:`finish` wrote, or None if the run is not finished."""
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
        """Close parts and logger, and release the folder.

        A run that a UserError ended before anything was learned leaves no folder.

        Args:
            error: why the run stopped early, if it did.
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

    def __exit__(self, *raised: Any) -> None:
        self.close(raised[1])

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
        # JSON makes tuples into lists, as they are once written.
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
        changed = differences(before, self._written_config(), ignore)
        if changed:
            more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
            raise UserError(
                f"{self.folder} was made with other settings ({'; '.join(changed[:3])}{more}): "
                "choose another out=, or delete the folder."
            )

    def _write_config(self) -> None:
        """An unfinished run continues with the new values of keys that may differ."""
        path = self.folder / "config.yaml"
        config = self._written_config()
        if path.exists():
            before = flat(parse_yaml(read_text(path)), keep_empty=True)
            now = flat(config, keep_empty=True)
            if self.finished or all(before.get(key, now[key]) == now[key] for key in now):
                return
        write_atomically(path, yaml.safe_dump(config, sort_keys=False))

    def _check_checkpoints(self) -> None:
        """Refuse a damaged checkpoint now, not hours later when it is needed."""
        if not self.finished:
            for path in sorted(self.folder.glob("*.safetensors")):
                load_state(path)

    def _write_versions(self) -> None:
        path = self.folder / "versions.json"
        if self.finished and path.exists():
            return  # These versions did not make it.
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
    if not getattr(part, "is_closed", False):  # TorchRL's collectors close environments too.
        part.close()
