import pytest
import yaml

from giril_rl.config.compose import resolved
from giril_rl.config.knobs import flat, knobs
from giril_rl.config.recipes import config_class, find, shipped, shipped_conf
from giril_rl.config.schema import (
    ExpertRunConfig,
    PPOConfig,
    RunConfig,
    TaskConfig,
)
from giril_rl.config.tasks import apply_task_defaults, task_defaults
from giril_rl.methods import ControlRunConfig, methods

PONG, PENDULUM = "ALE/Pong-v5", "Pendulum-v1"
VECTORS_ALONE = [name for name, method in methods().items() if not method.frames]
RECIPES = [recipe.name for recipe in shipped() if recipe.name not in VECTORS_ALONE]


def task(env_id):
    return TaskConfig(name="test", env_id=env_id)


def test_only_atari_has_settings_of_its_own():
    assert task_defaults(PENDULUM) == {}
    whole = yaml.safe_load((shipped_conf() / "kind" / "atari.yaml").read_text())
    assert task_defaults(PONG) == flat(whole)
    assert task_defaults(PONG)["ppo.clip_value"] is True


def test_every_key_belongs_to_a_recipe():
    known = {knob.key for name in RECIPES for knob in knobs(config_class(find(name)))}
    assert task_defaults(PONG).keys() <= known


@pytest.mark.parametrize(
    ("chosen", "gone"),
    [
        (["ppo.rollout"], {"ppo.rollout"}),
        (["demo"], {"demo.length", "demo.episodes", "demo.subsample"}),
        (["pp", "demo.len", "seed"], set()),
    ],
)
def test_what_somebody_chose_is_left_out(chosen, gone):
    everything = task_defaults(PONG)
    left = task_defaults(PONG, chosen)
    assert everything.keys() - left.keys() == gone
    assert left.items() <= everything.items()


def test_a_caller_cannot_change_them():
    task_defaults(PONG)["ppo.num_envs"] = 1
    assert task_defaults(PONG)["ppo.num_envs"] == 8


def test_a_config_takes_over_the_keys_that_it_has():
    config = RunConfig(task=task(PONG))
    assert apply_task_defaults(config, ["ppo.minibatch"]) is config
    ppo = {"num_envs": 8, "rollout": 128, "epochs": 4, "lr": 2.5e-4, "anneal_lr": True}
    clipped = {"clip_value": True, "entropy_coef": 0.01, "normalise_observations": False}
    assert config.ppo == PPOConfig(**ppo, **clipped, minibatch=PPOConfig().minibatch)
    assert not hasattr(config, "demo") and not hasattr(config, "clip_reward")


def test_experts_clip_the_reward_and_controls_normalise_pixels():
    assert apply_task_defaults(ExpertRunConfig(task=task(PONG))).clip_reward
    assert not apply_task_defaults(ExpertRunConfig(task=task(PENDULUM))).clip_reward
    control = apply_task_defaults(ControlRunConfig(task=task(PONG)))
    assert (control.giril.normalise, control.icm.normalise) == ("pixels", "pixels")
    assert control.reward == "constant"  # A word there, not the settings of a reward model.


def test_vectors_keep_the_recipe_s_own():
    assert apply_task_defaults(RunConfig(task=task(PENDULUM))) == RunConfig(task=task(PENDULUM))


@pytest.mark.parametrize("name", RECIPES)
@pytest.mark.parametrize("choice", ["task=breakout", "task.env_id=ALE/Pong-v5"])
def test_every_recipe_accepts_them(name, choice):
    recipe = find(name)
    config, _ = resolved(recipe, config_class(recipe), [choice])
    assert config.ppo.num_envs == 8 and config.ppo.clip_value
    for part in ("reward", "giril", "icm"):
        assert getattr(getattr(config, part, None), "normalise", "pixels") == "pixels"
