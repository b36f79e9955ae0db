"""Checks a reward module, as :func:`torchrl.envs.check_env_specs` checks an environment."""

from __future__ import annotations

import copy

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.transforms.intrinsic import IntrinsicReward

CHECKED = "checked_reward"


def check_reward(
    module: TensorDictModuleBase, batch: TensorDictBase, *, deterministic: bool = True
) -> None:
    """Checks on a batch of yours what transforms and training loops require of a reward module.

    - It writes one finite float per transition, shape ``(*batch, 1)``, for any batch shape.
    - A transition's reward does not depend on the other transitions or their number.
    - Calling it changes neither its state, nor the batch, nor the global random state.

    :class:`~giril_rl.transforms.IntrinsicReward` calls it, in eval mode and without gradient.

    Args:
        module: reads transitions and writes ``("next", "intrinsic_reward")``.
        batch: at least 3 transitions of any leading shape, with the module's ``in_keys``.
        deterministic: False for a reward with noise, which must come from the module's own
            generator.

    Raises:
        UserError: for the first requirement that is not met.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> batch = TensorDict({"observation": torch.randn(5, 2)}, [5])
        >>> keys = {"in_keys": ["observation"], "out_keys": [("next", "intrinsic_reward")]}
        >>> speed = TensorDictModule(lambda s: s.norm(dim=-1, keepdim=True), **keys)
        >>> check_reward(speed, batch)
        >>> shared = TensorDictModule(lambda s: s.mean().expand(*s.shape[:-1], 1), **keys)
        >>> check_reward(shared, batch)
        Traceback (most recent call last):
        giril_rl.errors.UserError: a transition's reward depends on the others in the batch: ...
    """
    # Under a key of its own, since the module may read the environment's reward.
    relabel = IntrinsicReward(module, reward_key=CHECKED, extrinsic_key=None)
    flat = batch.select(*module.in_keys).reshape(-1)
    if len(flat) < 3:
        raise UserError(f"the batch has {len(flat)} transitions: give at least 3.")
    if "next" not in flat.keys():
        flat = flat.set("next", TensorDict(batch_size=flat.batch_size))

    def rewards(data: TensorDictBase) -> Tensor:
        return relabel(data.clone()).get(("next", CHECKED))

    before, given = copy.deepcopy(module.state_dict()), flat.clone()
    random = torch.get_rng_state()
    whole = relabel(flat).get(("next", CHECKED))
    if whole.shape != (len(flat), 1) or not whole.is_floating_point():
        raise UserError(
            f"the reward of {len(flat)} transitions is {whole.dtype} of shape "
            f"{tuple(whole.shape)}: write floats of shape (*batch, 1)."
        )
    if not whole.isfinite().all():
        raise UserError("the reward is NaN or infinite on some transition of the batch.")
    if not torch.equal(torch.get_rng_state(), random):
        raise UserError(
            "the reward draws from torch's global generator: give the module one of its own."
        )
    for key in given.keys(True, True):
        if not torch.equal(flat.get(key), given.get(key)):
            raise UserError(f"the module changes {key!r} of the batch: write only the reward.")
    after = module.state_dict()
    changed = [k for k, v in before.items() if deterministic and not _same(v, after[k])]
    if changed:
        raise UserError(
            f"using the reward changes the module's {changed[0]!r}: update statistics where the "
            "reward is trained."
        )
    if not deterministic:
        return
    again = rewards(given)
    if not torch.equal(again, whole):
        raise UserError(
            "equal transitions get other rewards the second time: pass deterministic=False if "
            "that is meant."
        )
    third = len(flat) // 3
    for part in (slice(0, third), slice(third, len(flat))):
        if not _close(rewards(given[part]), whole[part]):
            raise UserError(
                "a transition's reward depends on the others in the batch: compute each from its "
                "own entries."
            )
    shaped = given[: 2 * third].reshape(2, third)
    if not _close(rewards(shaped), whole[: 2 * third].reshape(2, third, 1)):
        raise UserError("a batch of shape (2, n) gets other rewards than (2 n,): keep dimensions.")


def _same(one: object, other: object) -> bool:
    if isinstance(one, Tensor) and isinstance(other, Tensor):
        return torch.equal(one, other)
    return bool(one == other)


def _close(one: Tensor, other: Tensor) -> bool:
    """Equal but for the order of summation, which depends on a batch's shape."""
    return one.shape == other.shape and torch.allclose(one, other, rtol=1e-4, atol=1e-6)
