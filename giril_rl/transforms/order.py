"""Which observations a reward inside a TransformedEnv sees, by the order of the transforms."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator

from tensordict import unravel_key
from tensordict.utils import NestedKey
from torchrl.envs import (
    Compose,
    NextObservationDelta,
    ObservationNorm,
    Transform,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)

from giril_rl.errors import UserError

NORMALISERS = (ObservationNorm, VecNorm, VecNormV2)


def check_order(
    env: TransformedEnv, reward: Transform, in_keys: Collection[NestedKey], there: set[NestedKey]
) -> None:
    """Refuses an order in which a reward would see s and s' changed by different transforms.

    s' has passed the transforms before the reward. s comes from the last step and has passed all of
    them, except those that TorchRL inverts on the way to the environment.

    Args:
        env: the environment that the reward is in.
        reward: the reward's transform.
        in_keys: what the reward's module reads.
        there: observations that exist where the reward stands.

    Raises:
        UserError: naming the transform and the observation.

    Warns:
        UserWarning: where the reward sees observations that are normalised as they are played,
            which a demonstration often is not.

    Examples:
        >>> from giril_rl import IntrinsicReward
        >>> from giril_rl.rewards import CopyReward, ObservationScaler
        >>> from torchrl.envs import GymEnv
        >>> paid = IntrinsicReward(CopyReward(ObservationScaler(3, rule="raw")))
        >>> norm = ObservationNorm(0.0, 2.0, in_keys=["observation"])
        >>> TransformedEnv(GymEnv("Pendulum-v1"), Compose(paid, norm)).observation_spec
        Traceback (most recent call last):
        giril_rl.errors.UserError: ObservationNorm changes 'observation' after the reward, ...
    """
    chain = list(_flat(env.transform))
    place = next((i for i, part in enumerate(chain) if part is reward), None)
    if place is None:
        return
    read = [unravel_key(key) for key in in_keys]
    for key in there.intersection(read):
        changing = [part for part in chain if _changes(part, key)]
        before = [part for part in chain[:place] if part in changing]
        s = [part for part in changing if key not in part.in_keys_inv]
        if s != before:
            odd = next(part for part in changing if (part in s) != (part in before))
            name = type(odd).__name__
            if odd in s:
                raise UserError(
                    f"{name} changes {key!r} after the reward, which would see a changed s and an "
                    f"unchanged s': put {name} before the reward, or let it write another key "
                    "(out_keys)."
                )
            raise UserError(
                f"{name} changes {key!r} before the reward and is inverted on the way to the "
                "environment (in_keys_inv), so that the reward would see an unchanged s and a "
                f"changed s': put {name} after the reward, or let it write another key (out_keys)."
            )
        for part in before:
            if not isinstance(part, NORMALISERS) or key not in part.in_keys:
                continue
            name = type(part).__name__
            warnings.warn(
                f"the reward stands after {name} and sees normalised {key!r}: fit it on "
                f"transitions of this environment, or, for a raw demonstration, let {name} write "
                "another key (out_keys) for the policy.",
                UserWarning,
                stacklevel=2,
            )


def _flat(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for part in transform:
            yield from _flat(part)
    else:
        yield transform


def _changes(part: Transform, key: NestedKey) -> bool:
    from torchrl.record.recorder import VideoRecorder

    # These two name observations among their out_keys and leave them as they are.
    if isinstance(part, NextObservationDelta | VideoRecorder):
        return False
    return key in part.out_keys
