"""Trained modules as a folder of weights and a card, to be loaded anywhere."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Self

import torch
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec

from giril_rl.errors import UserError
from giril_rl.files.disk import installed_versions, read_json, remove_leftovers, write_json
from giril_rl.files.formats import check_format
from giril_rl.networks.action_bounds import single_action_spec

FORMAT_VERSION = 1
WEIGHTS = "model.safetensors"
CARD = "card.json"
MOST_ENTRIES = 10_000
"""Of a list in a card; each layer of a network is one."""

Constructor = Callable[..., Any]


def remembered(constructor: Constructor) -> Constructor:
    """Decorates a constructor whose arguments are then kept for :class:`Pretrained`.

    Args:
        constructor: an ``__init__``, or the function of a classmethod that makes an instance. Its
            arguments are numbers, texts, lists, keys and action specs.
    """
    signature = inspect.signature(constructor)

    @functools.wraps(constructor)
    def construct(owner: Any, *args: Any, **kwargs: Any) -> Any:
        made = constructor(owner, *args, **kwargs)
        bound = signature.bind(owner, *args, **kwargs)
        bound.apply_defaults()
        _, *given = bound.arguments.items()
        (owner if made is None else made)._made_by = constructor.__name__, dict(given)
        return made

    return construct


class Pretrained:
    """Gives a module ``save_pretrained`` and ``from_pretrained``.

    The folder holds ``model.safetensors`` and ``card.json``, as model hubs expect them: copy it, or
    upload it. Neither file can run code: the card names one of the class's own constructors
    and its arguments, which are numbers, texts and lists.

    Examples:
        >>> import tempfile
        >>> from giril_rl.rewards import GenerativeReward
        >>> spec = Bounded(-1, 1, shape=(1,))
        >>> reward = GenerativeReward.for_vectors(2, spec, normalise="raw")
        >>> folder = reward.save_pretrained(Path(tempfile.mkdtemp()) / "mine", {"task": "cart"})
        >>> again = GenerativeReward.from_pretrained(folder)
        >>> torch.equal(again.decoder[0].weight, reward.decoder[0].weight)
        True
        >>> read_json(folder / "card.json")["task"]
        'cart'
    """

    _made_by: tuple[str, dict[str, Any]] | None = None
    readable_formats: Collection[int] = (FORMAT_VERSION,)

    @property
    def card_format(self) -> int:
        """The format of this module's card; a card of an older one means another module."""
        return FORMAT_VERSION

    @property
    def made_with(self) -> dict[str, Any]:
        """The arguments of the constructor that made it, as a card has them; empty if none did."""
        return {key: plain(value) for key, value in (self._made_by or ("", {}))[1].items()}

    def save_pretrained(self, folder: Path | str, card: Mapping[str, Any] | None = None) -> Path:
        """Writes weights and card, replacing what an earlier call wrote.

        Args:
            folder: made if need be.
            card: what else the card is to say, such as method, task and scores; JSON values.

        Returns:
            The folder.

        Raises:
            UserError: if the module was put together by hand rather than by one of its
                constructors, so that a card could not say how to make it again.
        """
        from giril_rl.files.checkpoint import save_state

        if self._made_by is None:
            raise UserError(
                f"this {type(self).__name__} was made of networks of your own, which a card cannot "
                "describe: keep its state_dict() instead."
            )
        assert isinstance(self, nn.Module)
        folder = Path(folder)
        for name in (WEIGHTS, CARD):
            remove_leftovers(folder / name)
        save_state(folder / WEIGHTS, dict(self.state_dict()))
        made_by = {
            "class": type(self).__name__,
            "constructor": self._made_by[0],
            "arguments": self.made_with,
        }
        about = {"format_version": self.card_format, "made_by": made_by, **(card or {})}
        write_json(folder / CARD, {"versions": installed_versions(), **about})
        return folder

    @classmethod
    def from_pretrained(cls, folder: Path | str) -> Self:
        """The module that :meth:`save_pretrained` wrote, in eval mode, on the CPU.

        Raises:
            UserError: in one sentence, if the folder holds something else or is damaged.
        """
        from giril_rl.files.checkpoint import load_state

        folder = Path(folder)
        if not (folder / CARD).is_file() or not (folder / WEIGHTS).is_file():
            raise UserError(
                f"{folder} holds no saved module ({CARD} and {WEIGHTS}): check the path."
            )
        weights = load_state(folder / WEIGHTS)
        unfitting = UserError(
            f"{folder / WEIGHTS} does not fit its card: the two belong to different modules."
        )
        # A card may ask for a network of any size, so that it is made without memory first.
        if _shapes(cls._remade(folder / CARD, "meta").state_dict()) != _shapes(weights):
            raise unfitting
        module = cls._remade(folder / CARD, "cpu")
        try:
            module.load_state_dict(weights)
        except (RuntimeError, ValueError, TypeError):
            raise unfitting from None
        return module.eval()

    @classmethod
    def _remade(cls, path: Path, device: str) -> Any:
        card = read_json(path)
        written = card.get("format_version")
        check_format(
            written,
            cls.readable_formats,
            where=f"{path} has format",
            older="load it with the version that wrote it and save its module anew",
        )
        made_by = card.get("made_by")
        made_by = made_by if isinstance(made_by, dict) else {}
        if made_by.get("class") != cls.__name__:
            raise UserError(
                f"{path} is of a {made_by.get('class')}, not of a {cls.__name__}: load it with its "
                "own class."
            )
        constructor = _constructor(cls, made_by.get("constructor"))
        try:
            arguments = {key: _spoken(value) for key, value in made_by["arguments"].items()}
            with torch.device(device):
                made = constructor(**arguments)
        except Exception as error:  # Arguments of any kind and size raise nearly anything.
            reason = " ".join(str(error).split())[:200]
            raise UserError(
                f"{path} says of its {cls.__name__} what cannot be made ({reason}): restore a copy."
            ) from None
        if written < made.card_format:
            raise UserError(
                f"{path} has format {written}, of a policy or reward that this giril_rl would run "
                "otherwise than it was trained: train it anew, or use the version that wrote it."
            )
        return made


def _shapes(state: Mapping[str, Any]) -> dict[str, Any]:
    return {name: getattr(value, "shape", None) for name, value in state.items()}


def _constructor(cls: type, name: Any) -> Constructor:
    """One of the class's own decorated constructors, and nothing else."""
    if name == "__init__" and hasattr(vars(cls).get("__init__"), "__wrapped__"):
        return cls
    found = getattr(cls, name, None) if isinstance(name, str) and name.isidentifier() else None
    if not hasattr(found, "__wrapped__"):
        raise UserError(f"{cls.__name__} has no constructor {name!r}: the card is damaged.")
    return found  # type: ignore[return-value]


def plain(value: Any) -> Any:
    """A constructor's argument as the JSON value that a card has of it.

    Examples:
        >>> plain(Categorical(3, shape=(16,))), plain(("next", "observation"))
        ({'action_spec': 'discrete', 'n': 3}, ['next', 'observation'])
    """
    if isinstance(value, TensorSpec):
        return _plain_spec(single_action_spec(value))
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return value


def _plain_spec(value: TensorSpec) -> dict[str, Any]:
    if isinstance(value, (Categorical, OneHot)):
        kind = "one_hot" if isinstance(value, OneHot) else "discrete"
        return {"action_spec": kind, "n": int(value.space.n)}
    limit = torch.finfo(torch.float32).max  # JSON has no infinity.
    low, high = (
        bound.reshape(-1, value.shape[-1])[0].float().clamp(-limit, limit).tolist()
        for bound in (value.space.low, value.space.high)
    )
    return {"action_spec": "box", "low": low, "high": high}


def _spoken(value: Any) -> Any:
    if isinstance(value, list) and len(value) > MOST_ENTRIES:
        raise ValueError(f"a list of {len(value):,} entries")
    if isinstance(value, dict):
        kind = value["action_spec"]
        if kind == "box":
            low, high = torch.tensor(value["low"]), torch.tensor(value["high"])
            return Bounded(low, high, shape=low.shape, dtype=torch.float32)
        return {"discrete": Categorical, "one_hot": OneHot}[kind](int(value["n"]))
    if isinstance(value, list):
        return tuple(_spoken(entry) for entry in value)
    return value


def made_class(folder: Path | str) -> str | None:
    """The name of the class that a folder's card is of, None where it has none."""
    path = Path(folder) / CARD
    made_by = read_json(path).get("made_by") if path.is_file() else None
    name = made_by.get("class") if isinstance(made_by, dict) else None
    return name if isinstance(name, str) else None
