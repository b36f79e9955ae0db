"""Rewards of whole trajectories: what a step is worth depends on the episode's earlier steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.errors import UserError
from giril_rl.rewards.points import Atoms
from giril_rl.rewards.transitions import REWARD_KEYS, check_states, observation_shape, read
from giril_rl.runs.pretrained import Pretrained

NEXT, DONE = ("next", "observation"), ("next", "done")
STEP_KEYS: tuple[NestedKey, ...] = ("observation", "action", NEXT, DONE)
STATE_STEP_KEYS: tuple[NestedKey, ...] = ("observation", NEXT, DONE)
FOLLOWING: NestedKey = ("next", "following_observation")
EPISODE: NestedKey = "episode"


class TrajectoryReward(Pretrained, TensorDictModuleBase):
    """A reward that follows each environment's episode, step by step, in order of time.

    It takes batches ``(*environments, time)`` and gives the same numbers however time is cut into
    batches, down to single moments: :class:`~giril_rl.transforms.IntrinsicReward` hands it those in
    an environment. What it remembers of running episodes is in its ``state_dict``, and is sized to
    the environments by the first batch. An episode begins anew after ``("next", "done")``, and
    where a batch does not go on from where the last one ended, because the environment was reset in
    between. Where a batch has ``("next", "following_observation")`` (see
    :class:`giril_rl.envs.FixedHorizonEnv`), that is where an episode goes on. A change of
    ``"episode"``, which demonstrations have, ends one too.

    A subclass implements :meth:`begin`, :meth:`restart` and :meth:`pay`.

    Args:
        what: the reward's name in messages.
        atoms: the demonstration.
        in_keys: keys of observation, action (unless ``atoms`` leaves actions out), next observation
            and done.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for another number of keys; for a batch without time, out of its order, or with
            entries that are missing or of a wrong shape; for another number of environments while
            episodes are running.
    """

    along_time: ClassVar[bool] = True
    """Tells transforms to hand it batches with time as the last dimension."""
    optional_keys: ClassVar[tuple[NestedKey, ...]] = (FOLLOWING, EPISODE)
    """What it reads where it is there."""
    whole_episodes: ClassVar[bool] = False
    """Whether each step's reward is known at the episode's end only."""
    episode_state: ClassVar[tuple[str, ...]] = ("running", "expected")
    """The buffers that hold running episodes, one row for each environment."""

    running: Tensor
    expected: Tensor

    def __init__(
        self,
        what: str,
        atoms: Atoms,
        in_keys: Sequence[NestedKey] | None,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        super().__init__()
        wanted = STATE_STEP_KEYS if atoms.actions is None else STEP_KEYS
        in_keys = wanted if in_keys is None else in_keys
        if len(in_keys) != len(wanted) or len(out_keys) != 1:
            raise UserError(
                f"{what} has in_keys for {len(wanted)} entries such as {list(wanted)} and one "
                f"out_key, not {list(in_keys)} and {list(out_keys)}."
            )
        self.what, self.atoms = what, atoms
        self.in_keys: list[NestedKey] = list(in_keys)
        self.out_keys: list[NestedKey] = list(out_keys)
        self.register_buffer("running", torch.zeros(0, dtype=torch.bool))
        self.register_buffer("expected", torch.zeros(0, 0))
        self._fresh = self._learns_from_fresh = False

    def fit(self, pairs: TensorDictBase) -> Self:
        """Takes the demonstration's transitions, batch ``(n,)``; returns itself."""
        self.atoms.fit(*(pairs.get(key, None) for key in self.in_keys[:-2]))
        return self

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the rewards of a batch ``(*environments, time)``."""
        if tensordict.ndim < 2:
            raise UserError(
                f"{self.what} needs batches (environments, time) in order of time, not of shape "
                f"{tuple(tensordict.shape)}: relabel them as they were collected, before a replay "
                "buffer takes them; of one environment, give batch.unsqueeze(0)."
            )
        observation, *action, following, done = (
            entry.flatten(0, tensordict.ndim - 2) for entry in read(tensordict, self.in_keys)
        )
        check_states(observation, following)
        vectors = self.atoms(observation, *action)
        if 0 in tensordict.shape:
            return tensordict.set(self.out_keys[0], vectors.new_zeros(*tensordict.shape, 1).float())
        onward, episode = (tensordict.get(key, None) for key in self.optional_keys)
        if onward is not None:
            following = onward.flatten(0, tensordict.ndim - 2)
        ends = done.reshape(*vectors.shape[:2], -1).any(-1)
        if episode is not None:
            number = episode.reshape(*vectors.shape[:2])
            ends[:, :-1] |= number[:, 1:] != number[:, :-1]
        self._check_order(observation, following, ends)
        self._go_on_from(observation[:, 0])
        reward = self.pay(vectors, ends)
        self.running, self.expected = ~ends[:, -1], following[:, -1].clone()
        return tensordict.set(self.out_keys[0], reward.float().reshape(*tensordict.shape, 1))

    def begin(self, environments: int) -> None:
        """Begins the first episode of so many environments."""
        raise NotImplementedError

    def restart(self, where: Tensor) -> None:
        """Begins a new episode in the environments of a mask ``(environments,)``."""
        raise NotImplementedError

    def pay(self, vectors: Tensor, ends: Tensor) -> Tensor:
        """The rewards ``(environments, time)`` of the next steps of the running episodes.

        Args:
            vectors: float64 ``(environments, time, size)``, as :class:`Atoms` makes them.
            ends: bool ``(environments, time)``, after which steps an episode ends and another one
                begins.
        """
        raise NotImplementedError

    @contextmanager
    def fresh_episodes(self, *, learn: bool = False) -> Iterator[None]:
        """A context in which each batch holds whole episodes, apart from the running ones.

        Each environment's first step begins an episode, and the last one may lack its end. The
        running episodes stay as they are.

        Args:
            learn: whether they are the learner's own, from which a reward's scale may be learned.
        """
        kept = {name: getattr(self, name) for name in self.episode_state}
        before = self._fresh, self._learns_from_fresh
        self._fresh, self._learns_from_fresh = True, learn
        self._forget()
        try:
            yield
        finally:
            self._fresh, self._learns_from_fresh = before
            for name, value in kept.items():
                setattr(self, name, value)

    def save_pretrained(self, folder: Path | str, card: Mapping[str, Any] | None = None) -> Path:
        """See :class:`~giril_rl.runs.pretrained.Pretrained`; without the running episodes."""
        with self.fresh_episodes():
            return super().save_pretrained(folder, card)

    def _forget(self) -> None:
        self.running, self.expected = self.running.new_zeros(0), self.expected.new_zeros(0, 0)
        self.begin(0)

    def _check_order(self, observation: Tensor, following: Tensor, ends: Tensor) -> None:
        follows = (observation[:, 1:] == following[:, :-1]).all(-1) | ends[:, :-1]
        if not follows.all():
            environment, step = (~follows).nonzero()[0].tolist()
            raise UserError(
                f"{self.what} needs transitions in order of time, and step {step + 1} of "
                f"environment {environment} does not begin where step {step} led: give whole "
                "trajectories, neither shuffled nor thinned out."
            )

    def _go_on_from(self, observation: Tensor) -> None:
        """Compares with where the last batch ended; begins anew where it ended elsewhere."""
        number = len(observation)
        if self._fresh or (number != len(self.running) and not self.running.any()):
            self.begin(number)
        elif number != len(self.running):
            raise UserError(
                f"{self.what} follows the running episodes of {len(self.running)} environments, "
                f"and the batch has {number}: give whole batches, relabel other trajectories "
                "within reward.fresh_episodes(), or take a reward of its own for each."
            )
        else:
            elsewhere = (observation != self.expected).any(-1)
            if elsewhere.any():
                self.restart(elsewhere)

    def _load_from_state_dict(
        self, state_dict: Mapping[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        for name in self.episode_state:
            saved = state_dict.get(f"{prefix}{name}")
            if isinstance(saved, Tensor):
                setattr(self, name, torch.zeros_like(saved, device=getattr(self, name).device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def steps_before(ends: Tensor, before: Tensor) -> Tensor:
    """The steps that each step's episode had before it.

    Args:
        ends: bool ``(environments, time)``, after which steps an episode ends.
        before: the steps ``(environments,)`` that running episodes had before the first one.

    Examples:
        >>> steps_before(torch.tensor([[False, True, False]]), torch.tensor([7]))
        tensor([[7, 8, 0]])
    """
    time = torch.arange(ends.shape[1], device=ends.device)
    first = -before.unsqueeze(1)
    begins = torch.where(ends, time + 1, first).cummax(1).values
    return time - torch.cat([first, begins[:, :-1]], 1)


@contextmanager
def fresh_episodes(part: nn.Module, *, learn: bool = False) -> Iterator[None]:
    """:meth:`TrajectoryReward.fresh_episodes` of all trajectory rewards inside a transform.

    Rewards of single transitions need no such context, and nothing is done where there are none
    else.

    Args:
        part: a transform, a composition of them, or a reward.
        learn: see there.
    """
    with ExitStack() as stack:
        for module in trajectory_rewards(part):
            stack.enter_context(module.fresh_episodes(learn=learn))
        yield


def trajectory_rewards(part: nn.Module) -> list[TrajectoryReward]:
    """The trajectory rewards inside a transform or a reward, outermost first."""
    return [module for module in part.modules() if isinstance(module, TrajectoryReward)]


def check_vectors(what: str, observation: str) -> None:
    """Refuses a task that does not show vectors.

    Args:
        what: the method's name.
        observation: what the task shows, "vector" or "image".

    Examples:
        >>> check_vectors("PWIL", "image")
        Traceback (most recent call last):
        giril_rl.errors.UserError: PWIL measures distances of vectors and this task shows images:
        choose a task of vectors, or another method.
    """
    if observation != "vector":
        raise UserError(
            f"{what} measures distances of vectors and this task shows images: choose a task of "
            "vectors, or another method."
        )


def spaces_of(what: str, env: EnvBase, use_actions: bool) -> tuple[int, TensorSpec | None]:
    """Size of an environment's observations, and its action spec, None without ``use_actions``.

    Raises:
        UserError: if the environment shows images; ``what`` names the method.
    """
    frames, size = observation_shape(env)
    check_vectors(what, "image" if frames else "vector")
    return size, env.action_spec if use_actions else None
