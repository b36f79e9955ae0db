import math
from dataclasses import dataclass, field

import pytest

from giril_rl.config.schema import (
    AveragedRunConfig,
    DemoConfig,
    ExpertConfig,
    FitConfig,
    PPOConfig,
    RunConfig,
    TaskConfig,
    knob,
)
from giril_rl.config.validation import notices, validate
from giril_rl.errors import UserError
from giril_rl.rewards import AdversarialConfig, CuriosityConfig, GenerativeConfig


@dataclass
class Config(AveragedRunConfig):
    reward: GenerativeConfig = field(default_factory=GenerativeConfig)
    fit: FitConfig = field(default_factory=FitConfig)


def good() -> Config:
    return Config(task=TaskConfig(name="reach", env_id="Reach-v0"), steps=10_000)


def test_defaults_pass():
    validate(good())


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("reward.beta", 0.0, "reward.beta=0.0 must be greater than 0."),
        ("ppo.gamma", 1.01, "ppo.gamma=1.01 must be less than or equal to 1."),
        ("steps", 0, "steps=0 must be greater than or equal to 1."),
        ("steps", "1", "steps=1 must be a valid integer."),
        ("reward.alpha", -1.0, "reward.alpha=-1.0 must be greater than or equal to 0, or null."),
        ("ppo.hidden", [64, 0], "ppo.hidden[1]=0 must be greater than or equal to 1."),
        ("ppo.lr", math.nan, "ppo.lr=nan must be a finite number."),
        ("scaling.clip", math.inf, "scaling.clip=inf must be a finite number, or null."),
        ("profile", "papier", "profile=papier must be 'released' or 'paper'."),
        (
            "logger",
            "x",
            "logger=x must be 'tensorboard', 'csv', 'wandb' or 'mlflow', or null.",
        ),
        ("seed", 2**63, f"seed={2**63} must be less than or equal to {2**63 - 1}."),
        (
            "reward.seed",
            10**200,
            f"reward.seed=1{'0' * 19}... must be less than or equal to {2**63 - 1}, or null.",
        ),
        ("threads", 2**40, "threads=1099511627776 must be less than or equal to 1024."),
        ("imports", ["my_envs.py"], "'my_envs.py' is a file: import it by its name, my_envs."),
        ("imports", ["a b"], "'a b' is not the name of a module: write one such as my_envs."),
    ],
)
def test_refused_with_one_sentence(key, value, sentence):
    config = good()
    part = config
    *parents, name = key.split(".")
    for parent in parents:
        part = getattr(part, parent)
    setattr(part, name, value)
    with pytest.raises(UserError) as refusal:
        validate(config)
    assert str(refusal.value) == sentence


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("beta", 1.0),
        ("beta", 1e-6),
        ("alpha", None),
        ("alpha", 0.0),
        ("hidden", []),
        ("seed", None),
    ],
)
def test_bounds_and_null_pass(key, value):
    validate(GenerativeConfig(**{key: value}))


@pytest.mark.parametrize(
    ("num_envs", "rollout", "minibatch", "fits"),
    [(16, 512, 256, True), (3, 10, 30, True), (3, 10, 60, False), (2, 8, 3, False)],
)
def test_minibatch_divides_the_batch(num_envs, rollout, minibatch, fits):
    config = good()
    config.ppo = PPOConfig(num_envs=num_envs, rollout=rollout, minibatch=minibatch)
    config.steps = 10 * num_envs * rollout
    if fits:
        validate(config)
    else:
        with pytest.raises(UserError, match=rf"ppo\.minibatch={minibatch} does not divide"):
            validate(config)


@pytest.mark.parametrize(
    ("steps", "taken"), [(1, "2,000"), (1_999, "2,000"), (15_000, "16,000"), (16_000, None)]
)
def test_steps_are_rounded_up_to_whole_batches(steps, taken):
    config = good()
    config.steps = steps
    validate(config)
    batch = "is no multiple of a batch (16 * 125 = 2,000)"
    told = [f"steps={steps} {batch}: {taken} steps are taken."] if taken else []
    assert notices(config) == told


@dataclass
class WithExpert(RunConfig):
    expert: ExpertConfig = field(default_factory=lambda: ExpertConfig(steps=12_345))
    demo: DemoConfig = field(default_factory=DemoConfig)


def test_so_are_steps_of_an_expert_that_is_trained():
    config = WithExpert(task=TaskConfig(name="reach", env_id="Reach-v0"), steps=10_000)
    validate(config)
    (told,) = notices(config)
    assert told.startswith("expert.steps=12345 ") and told.endswith(": 14,000 steps are taken.")
    for part in (config.expert, config.demo):
        part.path = "somewhere"
        assert notices(config) == []
        part.path = None
    config.expert.steps, config.task.expert_steps = None, 1_999
    assert notices(config)[0].startswith("task.expert_steps=1999 ")


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("horizon", "long", "task.horizon=long must be 'own' or 'fixed'."),
        (
            "after_failure",
            "continue",
            "task.after_failure=continue means nothing where a failure ends the episode: "
            "add task.horizon=fixed.",
        ),
    ],
)
def test_the_horizon(key, value, sentence):
    config = good()
    setattr(config.task, key, value)
    with pytest.raises(UserError) as refusal:
        validate(config)
    assert str(refusal.value) == sentence
    config.task.horizon, config.task.after_failure = "fixed", "continue"
    validate(config)


@dataclass
class Control(RunConfig):
    giril: GenerativeConfig = field(default_factory=GenerativeConfig)
    icm: CuriosityConfig = field(default_factory=CuriosityConfig)


@dataclass
class Curious(RunConfig):
    reward: CuriosityConfig = field(default_factory=CuriosityConfig)


@dataclass
class Adversarial(RunConfig):
    reward: AdversarialConfig = field(default_factory=AdversarialConfig)


@pytest.mark.parametrize(
    ("env_id", "rule", "right"),
    [
        ("Reach-v0", "pixels", "standardise"),
        ("ALE/Pong-v5", "standardise", "pixels"),
        ("ALE/Pong-v5", "raw", "pixels"),
    ],
)
@pytest.mark.parametrize("kind", [Config, Curious, Adversarial])
def test_frames_and_vectors_are_not_normalised_alike(kind, env_id, rule, right):
    config = kind(task=TaskConfig(name="reach", env_id=env_id), steps=10_000)
    config.ppo.normalise_observations = right != "pixels"
    config.reward.normalise = rule
    with pytest.raises(UserError) as refusal:
        validate(config)
    assert str(refusal.value) == (
        f"reward.normalise={rule} does not fit the observations of reach: "
        f"set reward.normalise={right}."
    )
    config.reward.normalise = right
    validate(config)


@pytest.mark.parametrize("part", ["giril", "icm"])
def test_the_controls_models_are_held_to_the_same(part):
    config = Control(task=TaskConfig(name="pong", env_id="ALE/Pong-v5"), steps=10_000)
    config.giril.normalise = config.icm.normalise = "pixels"
    config.ppo.normalise_observations = False
    validate(config)
    getattr(config, part).normalise = "demo_range"
    with pytest.raises(UserError, match=rf"^{part}\.normalise=demo_range .*=pixels\.$"):
        validate(config)


@pytest.mark.parametrize("after_failure", ["reset", "continue"])
def test_games_have_no_fixed_horizon(after_failure):
    config = good()
    config.task = TaskConfig(
        name="pong", env_id="ALE/Pong-v5", horizon="fixed", after_failure=after_failure
    )
    config.reward.normalise, config.ppo.normalise_observations = "pixels", False
    with pytest.raises(UserError) as refusal:
        validate(config)
    assert str(refusal.value) == "task.horizon=fixed is for vector tasks: leave task.horizon=own."
    config.task = TaskConfig(name="pong", env_id="ALE/Pong-v5")
    validate(config)


@pytest.mark.parametrize(("steps", "taken"), [(2048, None), (2000, "2,048")])
def test_steps_of_atari_s_expert_are_its_own_batches(steps, taken):
    """8 games and 128 steps, whatever the recipe's own PPO has."""
    task = TaskConfig(name="pong", env_id="ALE/Pong-v5")
    config = WithExpert(task=task, steps=10_000, expert=ExpertConfig(steps=steps))
    config.ppo.normalise_observations = False
    validate(config)
    batch = "is no multiple of a batch (8 * 128 = 1,024)"
    told = [f"expert.steps={steps} {batch}: {taken} steps are taken."] if taken else []
    assert notices(config) == told


@pytest.mark.parametrize(
    ("length", "episodes", "fits"),
    [(1000, None, True), (None, 5, True), (1000, 5, False), (None, None, False)],
)
def test_demonstration_is_measured_one_way(length, episodes, fits):
    config = good()
    config.demo = DemoConfig(length=length, episodes=episodes)
    if fits:
        validate(config)
    else:
        with pytest.raises(UserError, match="exactly one"):
            validate(config)


def test_subsample_leaves_something():
    config = good()
    config.demo = DemoConfig(length=19, subsample=20)
    with pytest.raises(UserError, match=r"demo\.subsample=20 leaves nothing"):
        validate(config)


def test_bounds_of_an_open_upper_end():
    @dataclass
    class Part:
        share: float = knob(0.5, "a share", high=1, high_open=True)

    validate(Part(-3.0))
    with pytest.raises(UserError, match=r"share=1\.0 must be less than 1\."):
        validate(Part(1.0))


@pytest.mark.parametrize(
    ("part", "name"), [("ppo", "hidden"), ("reward", "hidden"), ("reward", "model_hidden")]
)
def test_layers_of_vectors_are_not_for_frames(part, name):
    kind = Curious if name == "model_hidden" else Config
    config = kind(task=TaskConfig(name="pong", env_id="ALE/Pong-v5"), steps=10_000)
    config.reward.normalise, config.ppo.normalise_observations = "pixels", False
    validate(config)
    setattr(getattr(config, part), name, [64])
    with pytest.raises(UserError) as refusal:
        validate(config)
    assert str(refusal.value) == (
        f"{part}.{name}=[64] is for vectors, and pong has frames, whose layers are fixed: leave it "
        "out."
    )
    config.task.env_id, config.reward.normalise = "Reach-v0", "raw"
    validate(config)


def test_frames_have_no_running_normalisation():
    config = Config(task=TaskConfig(name="pong", env_id="ALE/Pong-v5"), steps=10_000)
    config.reward.normalise = "pixels"
    with pytest.raises(UserError, match=r"^ppo\.normalise_observations=true .* leave it out\.$"):
        validate(config)
    config.ppo.normalise_observations = False
    validate(config)


def test_only_games_have_lives():
    config = Config(task=TaskConfig(name="reach", env_id="Reach-v0", episode="game"), steps=10_000)
    with pytest.raises(UserError, match=r"^task\.episode=game is for games, whose lives end"):
        validate(config)
