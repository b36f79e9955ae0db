from dataclasses import asdict, dataclass, field, replace

import pytest

from giril_rl.config.knobs import knobs
from giril_rl.config.schema import (
    EvalConfig,
    ExpertRunConfig,
    FitConfig,
    PPOConfig,
    RunConfig,
    TaskConfig,
)
from giril_rl.methods import ControlRunConfig
from giril_rl.rewards import BottleneckConfig, GenerativeConfig
from giril_rl.runs.identity import ADDED, NO_EFFECT, config_hash, variant, without_added

TASK = TaskConfig("pole", "Pole-v0", None, 300_000, 990.0)


@dataclass
class Fitted(RunConfig):
    reward: GenerativeConfig = field(default_factory=GenerativeConfig)
    fit: FitConfig = field(default_factory=FitConfig)


@dataclass
class Adversarial(RunConfig):
    reward: BottleneckConfig = field(default_factory=BottleneckConfig)


@pytest.mark.parametrize(
    ("kind", "digest"),
    [
        (ExpertRunConfig, "486a7d875a04"),
        (Fitted, "25c3b3dd6058"),
        (Adversarial, "f8c20818d091"),
    ],
)
def test_later_keys_leave_the_hashes_of_earlier_runs_as_they_are(kind, digest):
    """Recipes find their players by it: a new key belongs into ADDED or NO_EFFECT."""
    assert config_hash(kind(task=TaskConfig("pole", "Pole-v0"))) == digest


def test_what_has_no_effect_is_in_no_hash():
    config = Adversarial(task=TASK)
    fast = Adversarial(task=TASK, device="cuda", ppo=PPOConfig(compile=True))
    fast.reward.compile = True
    assert config_hash(fast) == config_hash(config)
    watched = replace(config, imports=["my_envs"], eval=EvalConfig(episodes=3, seed=7))
    watched.ppo = PPOConfig(checkpoint_every=7)
    assert config_hash(watched) == config_hash(config)
    assert variant({"ppo.compile": "ppo.compile=True", "device": "device=cuda"}) == "default"
    kinds = (ExpertRunConfig, ControlRunConfig, Fitted, Adversarial)
    assert {knob.key for kind in kinds for knob in knobs(kind)} >= NO_EFFECT


def test_later_keys_count_where_they_change_something():
    config = ExpertRunConfig(task=TASK)
    others = [
        replace(config, task=replace(TASK, horizon="fixed")),
        replace(config, task=replace(TASK, horizon="fixed", after_failure="continue")),
        replace(config, task=replace(TASK, expert_steps=1)),
        replace(config, task=replace(TASK, episode="game")),
        replace(config, ppo=PPOConfig(clip_value=True)),
        replace(config, clip_reward=True),
    ]
    assert len({config_hash(c) for c in [config, *others]}) == 7
    ours = ControlRunConfig(task=TASK)
    assert config_hash(replace(ours, termination="bootstrap")) != config_hash(ours)


def test_the_value_of_a_later_key_is_its_default():
    kinds = (ExpertRunConfig, ControlRunConfig, Fitted, Adversarial)
    defaults = {knob.key for kind in kinds for knob in knobs(kind)}
    assert set(ADDED) <= defaults
    assert without_added(asdict(ExpertRunConfig(task=TASK))).get("termination") is None
