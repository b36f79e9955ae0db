"""GIRIL on an environment of your own, from a demonstration in plain arrays.

From top to bottom: a Gymnasium environment (a ball on a beam), somebody's play of it as a file of
arrays, the file as a checked demonstration, a generative model of that, PPO on the model's reward,
and scores on the true reward, which nothing before has read. A constant reward is trained on as
well: what it reaches needed no demonstration.

What to expect: with either reward the ball stays on the beam, with the constant one in the middle
and with GIRIL's near an end, for GIRIL pays for what its model predicts badly.

    python docs/tutorials/giril_on_your_environment.py --steps 60000

The command line does the same with this file as a module of your own, in the current folder:

    cp docs/tutorials/giril_on_your_environment.py ball_on_beam.py
    python ball_on_beam.py --folder ball
    giril demo import ball/ball.npz --env-id ball_on_beam:BallOnBeam-v0 --out demos/ball
    giril run giril task.env_id=ball_on_beam:BallOnBeam-v0 demo.path=demos/ball out=runs/ball
    giril eval runs/ball --import ball_on_beam
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium import spaces
from torchrl.envs import Compose

from giril_rl import IntrinsicReward, ReturnScaling
from giril_rl.config.schema import PPOConfig, TaskConfig
from giril_rl.demos import Demonstration, import_demonstration, subsample
from giril_rl.envs import make_env
from giril_rl.rewards import ConstantReward, GenerativeReward, GenerativeRewardLoss, fit
from giril_rl.training import PPO, RandomPolicy, Run, Scores, evaluate, make_agent, train_policy

# 1. The environment. Observations are a vector, actions a Box or Discrete, and there is a time
#    limit. Everything random comes from `self.np_random`, so that a seed repeats an episode.


class BallOnBeam(gymnasium.Env):
    """A ball rolls on a beam whose slope is the action; off either end, the episode is over.

    Observation: place in [-1, 1] and speed of the ball. The true reward is 1 a step in the middle
    and 0 at an end.
    """

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):  # noqa: D102
        super().reset(seed=seed)
        self.place, self.speed = self.np_random.uniform(-0.5, 0.5, 2)
        return self._observe(), {}

    def step(self, action):  # noqa: D102
        slope = float(np.clip(action[0], -1, 1)) + self.np_random.normal(0, 0.1)
        self.speed += 0.1 * slope
        self.place += 0.1 * self.speed
        return self._observe(), 1 - abs(self.place), bool(abs(self.place) > 1), False, {}

    def _observe(self) -> np.ndarray:
        return np.array([self.place, self.speed], np.float32)


NAME = "BallOnBeam-v0"
if NAME not in gymnasium.registry:
    gymnasium.register(NAME, entry_point=BallOnBeam, max_episode_steps=200)
TASK = TaskConfig(name="ball", env_id=NAME)


# 2. The demonstration. Here two lines play well; yours may come from anywhere. Each episode has one
#    observation more than actions: the last one is what the last action led to.


def play(file: Path, episodes: int = 5) -> None:
    """Writes ``.npz`` arrays, episode after episode, see docs/demonstrations.md."""
    env = gymnasium.make(NAME)
    observations, actions, lengths, terminated = [], [], [], []
    for seed in range(episodes):
        observations.append(env.reset(seed=seed)[0])
        begun, over = len(actions), False
        while not over:
            place, speed = observations[-1]
            actions.append(np.clip([-2 * place - 3 * speed], -1, 1).astype(np.float32))
            observation, _, failed, cut, _ = env.step(actions[-1])
            observations.append(observation)
            over = failed or cut
        lengths.append(len(actions) - begun)
        terminated.append(failed)
    np.savez(
        file, observations=observations, actions=actions, lengths=lengths, terminated=terminated
    )


# 3. A reward that is fitted to the demonstration, before any policy is trained.


def generative_reward(demo: Demonstration, fit_steps: int) -> GenerativeReward:
    """GIRIL's conditional VAE, fitted to one transition in 10."""
    env = make_env(TASK, 1, seed=0)
    reward = GenerativeReward.for_vectors(
        env.observation_spec["observation"].shape[-1], env.action_spec
    )
    env.close()
    terms = fit(GenerativeRewardLoss(reward), subsample(demo, 10), steps=fit_steps, lr=1e-3)
    print("the model's losses:", {name: round(value, 4) for name, value in terms.items()})
    return reward


# 4. PPO on a reward: what the recipes do. The reward is put in the true one's place on each batch,
#    and divided by the running standard deviation of its return.


def train(reward, folder: Path, steps: int, seed: int = 0):
    """An agent that has maximised ``reward`` for ``steps`` steps; ``folder`` keeps the run."""
    cfg = PPOConfig(num_envs=8, rollout=128, minibatch=256)
    env = make_env(TASK, cfg.num_envs, seed)
    agent = make_agent(env, cfg, seed)
    relabel = Compose(IntrinsicReward(reward), ReturnScaling(cfg.gamma))
    with Run.open(folder, {"steps": steps, "seed": seed}, recipe="tutorial") as run:
        train_policy(env, PPO(agent, cfg, steps=steps), relabel, seed=seed, run=run)
    return agent


# 5. The score: the true return of whole episodes on fresh environments. Read the last two lines
#    first: a learned reward has shown something where it does better than they do.


def main(
    steps: int = 60 * 1024, fit_steps: int = 3000, episodes: int = 20, folder: Path | None = None
) -> dict[str, Scores]:
    """Runs all of it and returns the scores of each player."""
    folder = Path(tempfile.mkdtemp()) if folder is None else folder
    folder.mkdir(parents=True, exist_ok=True)
    play(folder / "ball.npz")
    demo = import_demonstration(str(folder / "ball.npz"), TASK)
    demo.save(folder / "demo")

    env = make_env(TASK, 1, seed=0)
    players = {
        "GIRIL": train(generative_reward(demo, fit_steps), folder / "giril", steps),
        "constant reward": train(ConstantReward(1.0), folder / "constant", steps),
        "random": RandomPolicy(env.action_spec),
    }
    env.close()
    return {
        name: evaluate(player, TASK, episodes=episodes, seed=1000, deterministic=False)
        for name, player in players.items()
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=60 * 1024, help="rounded up to 1,024s")
    parser.add_argument(
        "--folder", type=Path, help="where to keep all of it; if not given, nowhere"
    )
    args = parser.parse_args()
    for name, scores in main(args.steps, folder=args.folder).items():
        length = scores.episode_length_mean
        print(f"{name:16} return {scores.return_mean:5.1f}, {length:5.1f} of 200 steps")
