"""Writes this folder's data anew: ``python tests/data/make.py``.

It is kept to prove that files of an earlier giril_rl are still read: write it anew only where a
format has a new number, and keep the old files beside the new ones.
"""

import os
import shutil
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical

from giril_rl.cli.command_line import main
from giril_rl.demos import Demonstration, record_demonstration
from giril_rl.policies import ActorCritic, PixelActorCritic
from giril_rl.rewards import GenerativeReward

WORDS = [
    "task.env_id=CartPole-v1",
    "task.expert_steps=5000000",
    "demo.path=demonstration",
    "demo.subsample=2",
    "steps=256",
    "ppo.num_envs=2",
    "ppo.rollout=64",
    "ppo.minibatch=64",
    "ppo.epochs=1",
    "ppo.hidden=[8]",
    "reward.hidden=[8]",
    "fit.steps=10",
    "eval.episodes=1",
    "logger=null",
    "out=run",
]
"""The run's settings; the same words continue it."""


def vectors() -> Demonstration:
    return record_demonstration(
        lambda: gymnasium.make("CartPole-v1"),
        lambda observation: (observation[:, 2] + observation[:, 3] > 0).long(),
        length=40,
        seed=0,
        task="CartPole-v1",
    )


def images() -> Demonstration:
    frames = torch.arange(5, dtype=torch.uint8).reshape(5, 1, 1, 1).expand(5, 2, 6, 6).contiguous()
    end = torch.tensor([[False], [False], [False], [True]])
    after = {
        "observation": frames[1:],
        "reward": torch.ones(4, 1),
        "terminated": end,
        "truncated": ~end & False,
        "done": end,
    }
    transitions = {
        "observation": frames[:-1],
        "action": torch.tensor([0, 1, 2, 0]),
        "episode": torch.zeros(4, dtype=torch.int64),
        "step": torch.arange(4),
        "next": TensorDict(after, [4]),
    }
    return Demonstration(TensorDict(transitions, [4]), {"task": "frames", "seeds": [0]})


def pixels(archive: Path) -> None:
    """Policy and reward of a game, as large as the paper has them, with weights that compress."""
    spec = Categorical(4, shape=(1,), dtype=torch.int64)
    modules = {"policy": PixelActorCritic(4), "reward": GenerativeReward.for_pixels(spec)}
    with TemporaryDirectory() as place, zipfile.ZipFile(archive, "w", zipfile.ZIP_LZMA) as packed:
        for name, module in modules.items():
            for weight in module.parameters():
                steps = torch.arange(weight.numel()) % 11 - 5
                weight.data = (steps / (10 * weight[0].numel() ** 0.5)).reshape(weight.shape)
            folder = module.save_pretrained(Path(place) / name, {"task": "breakout"})
            for path in sorted(folder.iterdir()):
                packed.write(path, f"{name}/{path.name}")


def scaled() -> ActorCritic:
    """A policy whose actions are scaled to bounds, saved in a format of its own."""
    low, high = torch.tensor([1000.0, -0.5]), torch.tensor([2000.0, 0.5])
    policy = ActorCritic(2, Bounded(low, high, shape=(2,)), hidden=[])
    with torch.no_grad():
        policy.actor[-1].weight.copy_(torch.tensor([[0.5, 0.0], [0.0, 4.0]]))
    return policy


def make(folder: Path) -> None:
    os.chdir(folder)
    for name in ("demonstration", "demonstration_of_images", "run", "scaled_policy"):
        shutil.rmtree(name, ignore_errors=True)
    vectors().save("demonstration")
    images().save("demonstration_of_images")
    pixels(Path("pixels.zip"))
    scaled().save_pretrained("scaled_policy", {"task": "scaled"})
    assert main(["run", "giril", *WORDS]) == 0
    for picture in Path("run").glob("*.png"):
        picture.unlink()
    Path("run/.lock").unlink(missing_ok=True)


if __name__ == "__main__":
    make(Path(__file__).resolve().parent)
