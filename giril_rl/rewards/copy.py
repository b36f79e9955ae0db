"""A control that learns nothing: the error of foreseeing that nothing changes."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.rewards.chunks import per_transition
from giril_rl.rewards.equations import reconstruction_error
from giril_rl.rewards.keys import REWARD_KEYS, check_keys
from giril_rl.rewards.pixel_scaler import PixelScaler
from giril_rl.rewards.scaler import ObservationScaler
from giril_rl.rewards.transitions import check_states, read


class CopyReward(TensorDictModuleBase):
    """Eq. 2 with the copy predictor ``s_hat = s``: ``r = lambda * ||s - s'||^2``.

    It pays for how far the scaled (and clamped) state moves in a step. A generative model that has
    learned little more than that states change slowly pays much the same.

    Reads observation ``(*batch, d)``, or frames, and next observation, writes one reward per
    transition, ``(*batch, 1)``. Only the scaler has to be fitted.

    Args:
        scaler: applied to both observations.
        scale: lambda.
        in_keys: keys of observation and next observation.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: for another number of keys, or entries that are missing or of a wrong shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> s, following = torch.tensor([[0.0, 1.0]]), torch.tensor([[0.5, 3.0]])
        >>> batch = TensorDict({"observation": s, "next": {"observation": following}}, [1])
        >>> reward = CopyReward(ObservationScaler(2, rule="raw", clamp=False))
        >>> reward(batch)["next", "intrinsic_reward"].tolist()
        [[4.25]]
    """

    def __init__(
        self,
        scaler: ObservationScaler | PixelScaler,
        *,
        scale: float = 1.0,
        in_keys: Sequence[NestedKey] = ("observation", ("next", "observation")),
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        super().__init__()
        check_keys("a copy reward", ("observation", "next observation"), in_keys, out_keys)
        self.in_keys: list[NestedKey] = list(in_keys)
        self.out_keys: list[NestedKey] = list(out_keys)
        self.scaler = scaler
        self.scale = scale

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes each transition's reward."""
        observation, following = read(tensordict, self.in_keys)
        check_states(observation, following)
        error = per_transition(self._error, (observation, following), self.scaler.event_dims)
        return tensordict.set(self.out_keys[0], self.scale * error.unsqueeze(-1))

    def _error(self, observation: Tensor, following: Tensor) -> Tensor:
        pair = self.scaler(observation), self.scaler(following)
        return reconstruction_error(*pair, self.scaler.event_dims)
