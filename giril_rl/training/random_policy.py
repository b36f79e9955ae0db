"""The policy that a score of nothing learned comes from."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Categorical, OneHot, TensorSpec

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import spaces_of
from giril_rl.errors import UserError
from giril_rl.networks.action_bounds import affine_map, single_action_spec
from giril_rl.runs.randomness import stream_seed

RANDOM = "control:random"
"""The method's name in ``result.json``; such a run holds no policy."""


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
