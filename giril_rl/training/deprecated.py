"""What version 0.1 called parts of this room; goes in version 0.3."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import nn

from giril_rl.config.schema import PPOConfig
from giril_rl.envs import BatchedEnv
from giril_rl.policies import PPOAgent
from giril_rl.runs.run import Run
from giril_rl.training.loop import Trained, train_policy
from giril_rl.training.ppo import PPO
from giril_rl.training.reward_trainers import AdversarialTrainer, RewardTrainer

AdversarialLearner = AdversarialTrainer
RewardLearner = RewardTrainer


class PPOLearner(PPO):
    """:class:`PPO` with the number of steps done as an argument of each update."""

    def __init__(
        self, agent: PPOAgent, cfg: PPOConfig, *, total_steps: int, termination: str = "ends"
    ) -> None:
        super().__init__(agent, cfg, steps=total_steps, termination=termination)

    def learn(self, batch: TensorDictBase, taken: int) -> dict[str, float]:
        """:meth:`PPO.update` after ``taken`` steps."""
        self._taken = taken
        return self.update(batch)


def train_ppo(
    env: BatchedEnv,
    agent: PPOAgent,
    relabel: nn.Module,
    cfg: PPOConfig,
    *,
    steps: int,
    seed: int,
    run: Run,
    learn_reward: RewardTrainer | None = None,
    termination: str = "ends",
    **others: Any,
) -> Trained:
    """:func:`~giril_rl.training.train_policy` with :class:`PPO`."""
    ppo = PPO(agent, cfg, steps=steps, termination=termination)
    return train_policy(
        env, ppo, relabel, seed=seed, run=run, reward_trainer=learn_reward, **others
    )
