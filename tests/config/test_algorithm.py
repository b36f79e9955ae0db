"""The choice of the algorithm: what is refused, and what a run's identity has of it."""

import pytest

from giril_rl.config.compose import resolved
from giril_rl.config.recipes import config_class, find
from giril_rl.config.schema import RewardRunConfig, TaskConfig
from giril_rl.errors import UserError
from giril_rl.runs.identity import config_hash


@pytest.mark.parametrize(
    ("recipe", "words", "says"),
    [
        ("giril", ["ppo.lr=1e-3", "algorithm=sac"], "ppo.lr=0.001 has no effect"),
        ("giril", ["sac.lr=1e-2"], "sac.lr=0.01 has no effect with algorithm=ppo"),
        ("giril", ["algorithm=sac", "task=breakout"], "no networks for frames"),
        ("bc", ["algorithm=sac"], "cloning is no reinforcement learning"),
        ("giril", ["algorithm=td3"], "algorithm"),
    ],
)
def test_what_does_not_fit_the_algorithm_is_refused(recipe, words, says):
    found = find(recipe)
    with pytest.raises(UserError, match=says):
        resolved(found, config_class(found), words)


def test_a_run_is_known_by_the_settings_of_its_own_algorithm_alone():
    """And runs from before there was a choice keep their names."""
    task = TaskConfig(name="reach", env_id="Reach-v0")
    plain = RewardRunConfig(task=task, steps=10)
    hashes = {config_hash(plain)}
    plain.sac.lr = 0.5
    hashes.add(config_hash(plain))
    assert len(hashes) == 1
    plain.algorithm = "sac"
    with_sac = config_hash(plain)
    plain.ppo.lr = 0.5
    assert config_hash(plain) == with_sac not in hashes
    plain.sac.lr = 0.25
    assert config_hash(plain) != with_sac
