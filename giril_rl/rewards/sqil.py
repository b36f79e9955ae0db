"""SQIL: constant rewards, 1 for what was demonstrated and 0 for what the agent does itself.

Reddy et al., ICLR 2020, arXiv 1905.11108. There is nothing to train: the learner draws half of each
minibatch from the demonstration and half from its own transitions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from giril_rl.config.schema import knob
from giril_rl.errors import UserError
from giril_rl.rewards.controls import ConstantReward
from giril_rl.rewards.method import ORANGE, Method, register


@dataclass
class SQILConfig:
    """SQIL's two rewards."""

    demonstration: float = knob(1.0, "reward of the demonstration's transitions (paper: 1)")
    own: float = knob(0.0, "reward of the agent's own transitions (paper: 0)")

    def check(self, prefix: str, run: Any) -> None:
        """Refuses a learner without a replay, and a replay without the demonstration."""
        if run.task.family.observation == "image":
            raise UserError(
                f"SQIL learns of vectors and {run.task.name} shows images, for which SAC has no "
                "networks: choose another recipe."
            )
        if run.algorithm != "sac":
            raise UserError(
                f"algorithm={run.algorithm}: SQIL pays for transitions in a replay buffer, which "
                "PPO has not; leave algorithm=sac."
            )
        if run.sac.demonstration == "none":
            raise UserError(
                "sac.demonstration=none: all rewards of SQIL but the demonstration's are equal; "
                "leave sac.demonstration=half."
            )
        if run.scaling.enabled:
            raise UserError(
                "scaling.enabled=true: SQIL's own rewards are constant and have no scale; leave "
                "scaling.enabled=false."
            )


def sqil_reward(
    settings: SQILConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int = 0
) -> ConstantReward:
    """The reward of the agent's own transitions; the demonstration's is the learner's to add.

    Args:
        settings: the two rewards.
        env: has no effect, for no transition is read.
        pairs: have no effect.
        seed: has no effect, for nothing is random.

    Examples:
        >>> from tensordict import TensorDict
        >>> reward = sqil_reward(SQILConfig(), env=None, pairs=None)
        >>> reward(TensorDict(batch_size=[2]))["next", "intrinsic_reward"].flatten()
        tensor([0., 0.])
    """
    return ConstantReward(settings.own)


register(
    Method(
        "sqil",
        "SQIL",
        ORANGE,
        trained="never",
        settings=SQILConfig,
        build=sqil_reward,
        frames=False,
    )
)
