"""Policies that learned nothing: the scores below which a method has shown nothing."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Categorical, OneHot, TensorSpec

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import spaces_of
from giril_rl.errors import UserError
from giril_rl.networks.action_bounds import affine_map, single_action_spec
from giril_rl.rewards.method import GREY, RED, Method, register
from giril_rl.runs.progress import progress
from giril_rl.runs.randomness import stream_seed
from giril_rl.training.scoring import evaluate

RANDOM = "control:random"
"""Its method's name in ``result.json``; such a run holds no policy."""
HELD_ACTION = "control:held_action"
"""The method's name in ``result.json``; such a run holds no policy but the action's number."""

NO_REWARD: dict[str, Any] = {"kind": "control", "trained": "never", "demonstration": False}
register(Method(RANDOM, "control: random", GREY, rank=207, **NO_REWARD))
register(Method(HELD_ACTION, "control: held action", RED, rank=208, **NO_REWARD))


class RandomPolicy(TensorDictModuleBase):
    """Draws actions uniformly from the action space.

    The actions are a stream of their own: torch's global generator is neither read nor moved, so
    that policies of two seeds differ where evaluation seeds the global generator alike.

    Args:
        action_spec: the spec of a batched environment, whose first dimension is dropped.
        seed: of the actions.

    Raises:
        UserError: for actions without two bounds, which have no uniform distribution.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> policy = RandomPolicy(Bounded(-2.0, 2.0, shape=(16, 1)))
        >>> action = policy(TensorDict(batch_size=[5]))["action"]
        >>> action.shape, bool(action.abs().max() <= 2)
        (torch.Size([5, 1]), True)
    """

    def __init__(self, action_spec: TensorSpec, seed: int = 0) -> None:
        super().__init__()
        action_spec = single_action_spec(action_spec)
        if not (isinstance(action_spec, (Categorical, OneHot)) or _all_bounded(action_spec)):
            raise UserError(
                "actions without bounds have no uniform distribution: choose a task with bounded "
                "actions for the random policy."
            )
        self.in_keys: list[str] = []
        self.out_keys = ["action"]
        self.action_spec = action_spec
        self.seed = seed
        self._stream = torch.Generator().manual_seed(stream_seed("training", seed)).get_state()

    @classmethod
    def of_task(cls, task: TaskConfig, seed: int = 0) -> RandomPolicy:
        """The random policy of a task's action space."""
        return cls(spaces_of(task)[1], seed)

    def acting(self) -> RandomPolicy:
        """The same policy from its first action on."""
        return RandomPolicy(self.action_spec, self.seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes an action for each element of the batch."""
        with torch.random.fork_rng(devices=[]):  # Specs draw from the global generator alone.
            torch.set_rng_state(self._stream)
            action = self.action_spec[0].rand(tensordict.batch_size)
            self._stream = torch.get_rng_state()
        return tensordict.set("action", action)


def _all_bounded(spec: TensorSpec) -> bool:
    bounds = affine_map(spec)
    return bool((bounds.low.isfinite() & bounds.high.isfinite()).all())


class HeldAction(TensorDictModuleBase):
    """Takes one of the discrete actions, whatever it sees.

    The baseline "Const" of the Arcade Learning Environment (Bellemare et al., 2013, section 4).

    Args:
        action_spec: the environment's spec, of which the action has the encoding.
        action: the number of the action.

    Raises:
        UserError: for actions that are not discrete, or a number that is none of them.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> policy = HeldAction(Categorical(4, shape=(16,)), 2)
        >>> policy(TensorDict(batch_size=[3]))["action"]
        tensor([2, 2, 2])
    """

    def __init__(self, action_spec: TensorSpec, action: int) -> None:
        super().__init__()
        count = _number_of_actions(action_spec)
        if isinstance(action, bool) or not isinstance(action, int) or not 0 <= action < count:
            raise UserError(f"there is no action {action!r}: actions are 0 to {count - 1}.")
        self.in_keys: list[str] = []
        self.out_keys = ["action"]
        self.action = action
        one_hot = isinstance(single_action_spec(action_spec), OneHot)
        self._written = (
            torch.eye(count, dtype=torch.int64)[action] if one_hot else torch.tensor(action)
        )

    @classmethod
    def of_task(cls, task: TaskConfig, action: int) -> HeldAction:
        """The policy on a task's action space."""
        return cls(spaces_of(task)[1], action)

    def acting(self) -> HeldAction:
        """Itself, for it remembers nothing."""
        return self

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action for each element of the batch."""
        shape = (*tensordict.batch_size, *self._written.shape)
        return tensordict.set("action", self._written.expand(shape).clone())


def check_discrete(task: TaskConfig) -> None:
    """Refuses a task that has no actions to hold, before any long work.

    Raises:
        UserError: for actions that are not discrete.
    """
    _number_of_actions(spaces_of(task)[1])


def held_action_scores(task: TaskConfig, *, episodes: int, seed: int) -> list[float]:
    """The mean score of each action of a task when nothing else is done.

    Args:
        task: the task; whole games of it are played.
        episodes: episodes for each action, the same ones for all.
        seed: root of the episodes' seeds.

    Examples:
        >>> task = TaskConfig(name="cartpole", env_id="CartPole-v1")
        >>> scores = held_action_scores(task, episodes=5, seed=0)
        >>> len(scores), all(8 <= score <= 11 for score in scores)
        (2, True)
    """
    spec = spaces_of(task)[1]
    scores = []
    count = _number_of_actions(spec)
    with progress(count, desc="held actions", unit="actions") as bar:
        for action in range(count):
            policy = HeldAction(spec, action)
            played = evaluate(
                policy,
                task,
                episodes=episodes,
                seed=seed,
                deterministic=True,
                use="training",
                show_progress=False,
            )
            scores.append(played.return_mean)
            bar.update(1)
    return scores


def _number_of_actions(spec: TensorSpec) -> int:
    spec = single_action_spec(spec)
    if not isinstance(spec, (Categorical, OneHot)):
        raise UserError(
            "reward=held_action needs discrete actions, and this task's are continuous: choose "
            "another control."
        )
    return int(spec.space.n)
