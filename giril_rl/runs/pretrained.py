"""Sharing a trained module as a folder of weights and a card.

``huggingface_hub.PyTorchModelHubMixin`` writes a similar folder. We do not use it: it knows only
one constructor of a class, has no format number and no refusal in one sentence, and would be one
more dependency for two small files.
"""

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
from giril_rl.files.disk import read_json, remove_leftovers, write_json
from giril_rl.files.untrusted import check_format
from giril_rl.networks.action_bounds import single_action_spec
from giril_rl.runs.checkpoint import load_state, save_state
from giril_rl.runs.machine import installed_versions

FORMAT_VERSION = 1
WEIGHTS = "model.safetensors"
CARD = "card.json"
MOST_ENTRIES = 10_000
"""The longest list that a card may hold; a list may become the layers of a network."""

Constructor = Callable[..., Any]


def remembered(constructor: Constructor) -> Constructor:
    """Decorates a constructor so that :class:`Pretrained` knows its arguments.

    Args:
        constructor: an ``__init__``, or the function of a classmethod that makes an instance. Its
            arguments may be numbers, strings, lists, nested keys and action specs.
    """
    signature = inspect.signature(constructor)

    @functools.wraps(constructor)
    def construct(owner: Any, *args: Any, **kwargs: Any) -> Any:
        made = constructor(owner, *args, **kwargs)
        bound = signature.bind(owner, *args, **kwargs)
        bound.apply_defaults()
        _, *others = bound.arguments.items()
        given = dict(others)
        for name, parameter in signature.parameters.items():
            if parameter.kind is parameter.VAR_KEYWORD:
                given |= given.pop(name)
        (owner if made is None else made)._made_by = constructor.__name__, given
        return made

    return construct


class Pretrained:
    """Gives a module ``save_pretrained`` and ``from_pretrained``.

    The folder holds ``model.safetensors`` and ``card.json``. Neither can run code: the card names
    one of the class's own constructors that are :func:`remembered`, and plain arguments for it.

    Examples:
        >>> import tempfile
        >>> class Affine(Pretrained, nn.Linear):
        ...     @remembered
        ...     def __init__(self, size: int) -> None:
        ...         super().__init__(size, size)
        >>> affine = Affine(3)
        >>> folder = affine.save_pretrained(Path(tempfile.mkdtemp()) / "mine", {"task": "cart"})
        >>> torch.equal(Affine.from_pretrained(folder).weight, affine.weight)
        True
        >>> card = read_json(folder / "card.json")
        >>> card["task"], card["made_by"]["arguments"]
        ('cart', {'size': 3})
    """

    _made_by: tuple[str, dict[str, Any]] | None = None
    readable_formats: Collection[int] = (FORMAT_VERSION,)

    @property
    def card_format(self) -> int:
        """The card format of this module; a card with an older one describes another module."""
        return FORMAT_VERSION

    @property
    def made_with(self) -> dict[str, Any]:
        """The constructor's arguments as in a card; empty if it was not :func:`remembered`."""
        return {key: plain(value) for key, value in (self._made_by or ("", {}))[1].items()}

    def save_pretrained(self, folder: Path | str, card: Mapping[str, Any] | None = None) -> Path:
        """Write weights and card, replacing earlier ones.

        Args:
            folder: the folder, which may not exist yet.
            card: more entries for the card, such as method, task and scores; JSON values.

        Returns:
            The folder.

        Raises:
            UserError: if the module was made of networks passed in by hand, which a card cannot
                describe.
        """
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
        """Load a module that :meth:`save_pretrained` wrote, in eval mode, on the CPU.

        Raises:
            UserError: if the folder holds something else or is damaged.
        """
        folder = Path(folder)
        if not (folder / CARD).is_file() or not (folder / WEIGHTS).is_file():
            raise UserError(
                f"{folder} holds no saved module ({CARD} and {WEIGHTS}): check the path."
            )
        weights = load_state(folder / WEIGHTS)
        unfitting = UserError(
            f"{folder / WEIGHTS} does not fit its card: the two belong to different modules."
        )
        # A card may ask for a network of any size: first make it without memory.
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
            arguments = {key: _from_plain(value) for key, value in made_by["arguments"].items()}
            with torch.device(device):
                made = constructor(**arguments)
        except Exception as error:  # Wrong arguments can raise anything.
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
    """The class's own constructor of that name, if it is :func:`remembered`."""
    if name == "__init__" and hasattr(vars(cls).get("__init__"), "__wrapped__"):
        return cls
    found = getattr(cls, name, None) if isinstance(name, str) and name.isidentifier() else None
    if not hasattr(found, "__wrapped__"):
        raise UserError(f"{cls.__name__} has no constructor {name!r}: the card is damaged.")
    return found  # type: ignore[return-value]


def plain(value: Any) -> Any:
    """A constructor's argument as JSON.

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


def _from_plain(value: Any) -> Any:
    """The inverse of :func:`plain`."""
    if isinstance(value, list) and len(value) > MOST_ENTRIES:
        raise ValueError(f"a list of {len(value):,} entries")
    if isinstance(value, dict):
        kind = value["action_spec"]
        if kind == "box":
            low, high = torch.tensor(value["low"]), torch.tensor(value["high"])
            return Bounded(low, high, shape=low.shape, dtype=torch.float32)
        return {"discrete": Categorical, "one_hot": OneHot}[kind](int(value["n"]))
    if isinstance(value, list):
        return tuple(_from_plain(entry) for entry in value)
    return value


def made_class(folder: Path | str) -> str | None:
    """The class named in a folder's card, None if there is none."""
    path = Path(folder) / CARD
    made_by = read_json(path).get("made_by") if path.is_file() else None
    name = made_by.get("class") if isinstance(made_by, dict) else None
    return name if isinstance(name, str) else None
