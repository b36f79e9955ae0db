"""An expert's transitions, and a card that says where they come from."""

from __future__ import annotations

import hashlib
import math
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.demos.soundness import check_transitions
from giril_rl.demos.storage import (
    FRAMES_FILE,
    load_frames,
    load_tensors,
    save_frames,
    save_tensors,
)
from giril_rl.errors import UserError
from giril_rl.files.disk import name_file, read_json, temporary_sibling, write_json
from giril_rl.files.untrusted import check_format

FORMAT_VERSION = 1
"""Of vectors."""
IMAGE_FORMAT_VERSION = 2
"""Of images, which lie in a file of their own."""

_AT_ONCE = 10_000
_IMAGES: list[NestedKey] = ["observation", ("next", "observation")]


@dataclass(eq=False)
class Demonstration:
    """Transitions (s_t, a_t, s_{t+1}) of whole episodes, in the order in which they were played.

    Args:
        transitions: flat TensorDict, batch [N]: ``observation`` float32 [N, d], before any
            normalisation, or images, uint8 [N, c, h, w]; ``action``, as executed, float32 [N, a] or
            int64 [N], or none; ``("next", "observation")``, at an episode's end the true terminal
            observation; ``("next", "reward" | "done" | "terminated" | "truncated")`` [N, 1];
            ``episode`` and ``step`` int64 [N], both counted from 0.
        card: plain JSON values. ``length`` is the fixed number of transitions, which may cut the
            last episode, or None if all episodes are whole; ``seeds`` has one reset seed per
            episode; ``actions`` is False if there are none. The others are listed by
            :func:`giril_rl.demos.record_demonstration`.

    Examples:
        >>> import gymnasium
        >>> from giril_rl.demos import record_demonstration
        >>> balance = lambda observation: (observation[:, 2] + observation[:, 3] > 0).long()
        >>> demo = record_demonstration(
        ...     lambda: gymnasium.make("CartPole-v1"), balance, episodes=2, seed=0
        ... )
        >>> bool((demo.returns == demo.lengths).all())  # CartPole pays 1 a step
        True
        >>> demo.num_episodes, demo.transitions["next", "observation"].shape[-1]
        (2, 4)
    """

    transitions: TensorDict
    card: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return self.transitions.shape[0]

    @property
    def has_images(self) -> bool:
        """Whether observations are images rather than vectors."""
        return self.transitions["observation"].dtype == torch.uint8

    @property
    def has_actions(self) -> bool:
        """Whether it has actions, rather than states alone."""
        return self.card.get("actions") is not False

    @property
    def has_rewards(self) -> bool:
        """Whether the true rewards are known; unknown ones are stored as zeros."""
        return self.card.get("rewards") is not False

    @property
    def num_episodes(self) -> int:
        """Number of episodes, a cut one included."""
        return int(self.transitions["episode"].max()) + 1 if len(self) else 0

    @property
    def returns(self) -> Tensor:
        """Undiscounted true return of each episode, float64 [num_episodes]."""
        rewards = self.transitions["next", "reward"].reshape(-1).double()
        sums = torch.zeros(self.num_episodes, dtype=torch.float64)
        return sums.index_add(0, self.transitions["episode"], rewards)

    def mean_return(self, episodes: int | None = None) -> float:
        """Mean true return of the first ``episodes`` episodes, of all by default.

        A cut one counts only where there is no other. Of a part of a demonstration it is the mean
        of the whole episodes that the part was taken from.
        """
        taken = self.card.get("taken_from")
        mean = taken.get("return_mean") if isinstance(taken, dict) else None
        if episodes is None and isinstance(mean, float) and math.isfinite(mean):
            return mean
        returns = self.returns
        if not self.transitions["next", "done"][-1] and len(returns) > 1:
            returns = returns[:-1]
        return returns[:episodes].mean().item()

    @property
    def lengths(self) -> Tensor:
        """Transitions of each episode, int64 [num_episodes]."""
        return torch.bincount(self.transitions["episode"], minlength=self.num_episodes)

    @property
    def demo_id(self) -> str:
        """Twelve hex digits of the transitions' sha256, independent of card and storage.

        Examples:
            >>> one = Demonstration(TensorDict({"step": torch.arange(3)}, [3]), {"task": "reach"})
            >>> same = Demonstration(TensorDict({"step": torch.arange(3)}, [3]))
            >>> one.demo_id == same.demo_id, one.demo_id
            (True, '...')
        """
        digest = hashlib.sha256()
        for key in sorted(self.transitions.keys(True, True), key=str):
            values = self.transitions.get(key)
            digest.update(f"{key}{values.dtype}{tuple(values.shape)}".encode())
            for part in values.split(_AT_ONCE):
                digest.update(part.cpu().contiguous().numpy())
        return digest.hexdigest()[:12]

    def check(self) -> None:
        """Refuses faults that show without the task, as :func:`check_demonstration` does first.

        Raises:
            UserError: naming the first fault found and where it is.
        """
        check_transitions(
            self.transitions,
            may_cut_last=self.card.get("length") is not None,
            actions=self.has_actions,
        )

    def without_actions(self) -> Demonstration:
        """The same states alone; the card says so.

        Examples:
            >>> data = TensorDict({"action": torch.zeros(3), "step": torch.arange(3)}, [3])
            >>> states = Demonstration(data).without_actions()
            >>> list(states.transitions.keys()), states.has_actions
            (['step'], False)
        """
        return Demonstration(self.transitions.exclude("action"), {**self.card, "actions": False})

    def save(self, folder: Path | str) -> None:
        """Writes ``folder`` atomically: a TensorDict memmap, ``card.json``, and images' frames.

        Raises:
            UserError: if the demonstration is not sound, or ``folder`` is there already.

        Examples:
            >>> import tempfile, gymnasium
            >>> from giril_rl.demos import record_demonstration
            >>> demo = record_demonstration(
            ...     lambda: gymnasium.make("CartPole-v1"), lambda o: o.new_ones(1).long(),
            ...     length=30, seed=0,
            ... )
            >>> folder = Path(tempfile.mkdtemp()) / "demo"
            >>> demo.save(folder)
            >>> bool((Demonstration.load(folder).transitions == demo.transitions).all())
            True
        """
        folder = Path(folder)
        self.check()
        if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
            raise UserError(f"{folder} is there already: choose another folder, or delete it.")
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_sibling(folder)
        shutil.rmtree(temporary, ignore_errors=True)
        try:
            data, card = self.transitions, {"format_version": FORMAT_VERSION, **self.card}
            if self.has_images:
                temporary.mkdir()
                images = data["observation"], data["next", "observation"]
                card["format_version"] = IMAGE_FORMAT_VERSION
                card["frames"] = save_frames(temporary / FRAMES_FILE, *images)
                data = data.exclude(*_IMAGES)
            save_tensors(temporary / "transitions", data)
            write_json(temporary / "card.json", card)
            temporary.replace(folder)
        except BaseException as error:
            name_file(error, folder)
            shutil.rmtree(temporary, ignore_errors=True)
            raise

    @classmethod
    def load(cls, folder: Path | str) -> Demonstration:
        """Reads into memory, and checks, what :meth:`save` wrote.

        Nothing is unpickled: all metadata is checked before anything is loaded, and a folder that
        holds more than plain tensors is refused.

        Raises:
            UserError: if something is missing, damaged, of another format or not sound.
        """
        folder = Path(folder)
        if not (folder / "card.json").is_file():
            raise UserError(
                f"{folder} is not a demonstration (no card.json): check the path, "
                "or record one anew."
            )
        card = read_json(folder / "card.json")
        version = card.get("format_version")
        check_format(
            version,
            [FORMAT_VERSION, IMAGE_FORMAT_VERSION],
            where=f"{folder} has demonstration format",
            older="export it as .npz with the version that wrote it and import that, or record it "
            "anew",
        )
        if version == IMAGE_FORMAT_VERSION and not (folder / FRAMES_FILE).is_file():
            raise UserError(
                f"{folder} has demonstration format {version} and no {FRAMES_FILE}: restore a "
                "copy, or record it anew."
            )
        data = load_tensors(folder / "transitions")
        if version == IMAGE_FORMAT_VERSION:
            length = data.shape[0] if data.ndim else 0
            images = load_frames(folder / FRAMES_FILE, card.get("frames"), length)
            for key, image in zip(_IMAGES, images, strict=True):
                data.set(key, image)
        demo = cls(data, card)
        try:
            demo.check()
        except UserError as error:
            raise UserError(f"{folder}: {error}") from None
        return demo
