"""A reward of your own in 40 lines: how near the next state is to the demonstration.

A reward is a TensorDictModule that reads a transition and writes ("next", "intrinsic_reward"), one
value for each. The one below needs no training: it keeps the demonstration's states and pays
exp(-d) for the distance d of the next state to the nearest one, in their standard deviations.
`check_reward` holds it to what is asked of every reward, and PPO maximises it. Afterwards the
policy is scored beside one that got a constant reward.

    python docs/tutorials/reward_of_your_own.py --steps 60000
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import Compose

from giril_rl import IntrinsicReward, ReturnScaling, check_reward
from giril_rl.config.schema import PPOConfig, TaskConfig
from giril_rl.demos import record_demonstration
from giril_rl.envs import gym_factory, make_env
from giril_rl.rewards import ConstantReward, ObservationScaler
from giril_rl.training import PPO, Run, Scores, evaluate, make_agent, train_policy

# The reward. From here ...


class NearestState(TensorDictModuleBase):
    """Pays for next states that are near any of the demonstration's.

    Args:
        states: the demonstration's observations ``(n, d)``.
        in_keys: key of the next observation ``(*batch, d)``.
        out_keys: where the reward ``(*batch, 1)`` is written.
    """

    states: Tensor

    def __init__(
        self,
        states: Tensor,
        *,
        in_keys=(("next", "observation"),),
        out_keys=(("next", "intrinsic_reward"),),
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)
        # Modules and buffers, not attributes: they are saved, and moved with .to(device).
        self.scaler = ObservationScaler(states.shape[-1], clamp=False).fit(states)
        self.register_buffer("states", self.scaler(states))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes each transition's reward."""
        following = self.scaler(tensordict.get(self.in_keys[0]))
        # cdist wants (n, d): leading dimensions, whatever they are, become one and return.
        distance = torch.cdist(following.reshape(-1, following.shape[-1]), self.states).amin(-1)
        reward = distance.neg().exp().reshape(*following.shape[:-1], 1)
        return tensordict.set(self.out_keys[0], reward)


# ... to here. The rest uses it like any other reward.

TASK = TaskConfig(name="cartpole", env_id="CartPole-v1")


def balance(observation: Tensor) -> Tensor:
    """Pushes to where the pole falls, a little before it does."""
    place, velocity, angle, rotation = observation.unbind(-1)
    return (0.05 * place + 0.1 * velocity + angle + 0.5 * rotation > 0).long()


def train(reward: TensorDictModuleBase, folder: Path, steps: int, seed: int = 0):
    """An agent that has maximised ``reward`` for ``steps`` steps; ``folder`` keeps the run."""
    cfg = PPOConfig(num_envs=8, rollout=128, minibatch=256)
    env = make_env(TASK, cfg.num_envs, seed)
    agent = make_agent(env, cfg, seed)
    relabel = Compose(IntrinsicReward(reward), ReturnScaling(cfg.gamma))
    with Run.open(folder, {"steps": steps, "seed": seed}, recipe="tutorial") as run:
        train_policy(env, PPO(agent, cfg, steps=steps), relabel, seed=seed, run=run)
    return agent


def main(
    steps: int = 60 * 1024, episodes: int = 20, folder: Path | None = None
) -> dict[str, Scores]:
    """Records, checks, trains, and returns the scores of each player."""
    folder = Path(tempfile.mkdtemp()) if folder is None else folder
    demo = record_demonstration(gym_factory(TASK), balance, episodes=2, seed=0).transitions

    reward = NearestState(demo["next", "observation"][::20])
    check_reward(reward, demo)  # Shape, finite, no transition's reward depends on another's, ...
    random = make_env(TASK, 1, seed=0).rollout(500, break_when_any_done=False)
    for name, batch in {"the demonstration": demo, "random actions": random}.items():
        paid = IntrinsicReward(reward)(batch.clone())["next", "reward"]
        print(f"reward of {name}: {paid.mean():.3f}")

    players = {
        "nearest state": train(reward, folder / "nearest", steps),
        "constant reward": train(ConstantReward(1.0), folder / "constant", steps),
    }
    return {
        name: evaluate(player, TASK, episodes=episodes, seed=1000, deterministic=False)
        for name, player in players.items()
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=60 * 1024, help="rounded up to 1,024s")
    args = parser.parse_args()
    for name, scores in main(args.steps).items():
        print(f"{name:16} true return {scores.return_mean:5.1f} of 500")
