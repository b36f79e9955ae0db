import hashlib
import json
from dataclasses import asdict, replace

from giril_rl.configs import ControlRunConfig, ExpertRunConfig, PPOConfig, TaskConfig
from giril_rl.naming import ADDED, config_hash, without_added
from giril_rl.schema import leaves

TASK = TaskConfig("pole", "Pole-v0", None, 300_000, 990.0)


def test_later_keys_leave_the_hashes_of_earlier_runs_as_they_are():
    """The configuration as it was written before those keys existed."""
    config = ExpertRunConfig(task=TASK)
    values = asdict(config)
    for key in ("horizon", "after_failure", "expert_steps", "episode"):
        del values["task"][key]
    del values["ppo"]["clip_value"]
    for key in ("termination", "clip_reward", "device", "out", "root", "logger", "threads"):
        del values[key]
    digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
    assert config_hash(config) == digest[:12]


def test_later_keys_count_where_they_change_something():
    config = ExpertRunConfig(task=TASK)
    others = [
        replace(config, termination="bootstrap"),
        replace(config, task=replace(TASK, horizon="fixed")),
        replace(config, task=replace(TASK, horizon="fixed", after_failure="continue")),
        replace(config, task=replace(TASK, expert_steps=1)),
        replace(config, task=replace(TASK, episode="game")),
        replace(config, ppo=PPOConfig(clip_value=True)),
        replace(config, clip_reward=True),
    ]
    assert len({config_hash(c) for c in [config, *others]}) == 8


def test_the_value_of_a_later_key_is_its_default():
    kinds = (ExpertRunConfig, ControlRunConfig)
    defaults = {leaf.key for kind in kinds for leaf in leaves(kind)}
    assert set(ADDED) <= defaults
    assert without_added(asdict(ExpertRunConfig(task=TASK))).get("termination") is None
