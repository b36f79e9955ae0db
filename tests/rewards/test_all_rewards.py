"""Every reward module against the shared checks; a new one is a ``register`` line below."""

import itertools
from typing import get_args

import pytest
import reward_checks as checks
import torch
from reward_cases import CASES, Setting, register
from tensordict.nn import TensorDictModule
from torch._subclasses.fake_tensor import DataDependentOutputException

from giril_rl.rewards import (
    AffineReward,
    BottleneckReward,
    ConstantReward,
    CopyReward,
    CuriosityReward,
    DiscriminatorReward,
    GenerativeReward,
    NoiseReward,
    ObservationScaler,
    PixelScaler,
    RewardForm,
)

RULES = ("demo_range", "standardise", "raw")


def generative(**kwargs):
    return lambda c: GenerativeReward.for_vectors(
        c.dim, c.spec, hidden=[16, 16], seed=c.seed, **kwargs, **c.reads()
    )


def curiosity(**kwargs):
    return lambda c: CuriosityReward.for_vectors(
        c.dim, c.spec, model_hidden=[16], seed=c.seed, **kwargs, **c.reads()
    )


def adversarial(cls, **kwargs):
    return lambda c: cls.for_vectors(
        c.dim, c.spec, hidden=[16, 16], seed=c.seed, **kwargs, **c.reads("observation", "action")
    )


def copied(c: Setting):
    scaler = ObservationScaler(c.dim, rule="standardise")
    return CopyReward(scaler, **c.reads("observation", "next_observation"))


def of_pixels(cls, *entries, **kwargs):
    return lambda c: cls.for_pixels(c.spec, seed=c.seed, **kwargs, **c.reads(*entries))


def copied_pixels(c: Setting):
    return CopyReward(PixelScaler(), **c.reads("observation", "next_observation"))


for rule, prior, beta in itertools.product(RULES, ("standard", "conditional"), (1.0, 0.9)):
    # Clamped raw observations would stop at 1, in the middle of the checks' data.
    build = generative(normalise=rule, prior=prior, beta=beta, clamp=rule != "raw")
    register(f"giril-{rule}-{prior}-{beta}", build, deterministic=beta == 1)
for rule in RULES:
    register(f"icm-{rule}", curiosity(normalise=rule, clamp=rule != "raw", hidden=[16, 16]))
register("icm-no-features", curiosity(hidden=[]))
FORMS = get_args(RewardForm)
for rule, form in itertools.product(("running", *RULES), FORMS):
    build = adversarial(DiscriminatorReward, normalise=rule, form=form)
    register(f"gail-{rule}-{form}", build, depends_on=("observation", "action"))
for rule, form in itertools.product(("running", "standardise"), FORMS):
    build = adversarial(BottleneckReward, normalise=rule, form=form, latent=4)
    register(f"vail-{rule}-{form}", build, depends_on=("observation", "action"))
register("copy", copied, depends_on=("observation", "next_observation"))
register(
    "constant", lambda c: ConstantReward(2.0, out_keys=c.out_keys), depends_on=(), learned=False
)
register(
    "noise",
    lambda c: NoiseReward(2.0, 0.5, seed=c.seed, out_keys=c.out_keys),
    depends_on=(),
    deterministic=False,
)
register("negated-giril", lambda c: AffineReward(generative()(c), -1.0))
register(
    "centred-giril",
    lambda c: AffineReward(generative(beta=0.9)(c), shift=-0.3),
    deterministic=False,
)

for prior, beta in itertools.product(("standard", "conditional"), (1.0, 0.9)):
    build = of_pixels(GenerativeReward, prior=prior, beta=beta)
    register(f"giril-{prior}-{beta}", build, deterministic=beta == 1, pixels=True)
register("icm", of_pixels(CuriosityReward), pixels=True)
for name, cls in (("gail", DiscriminatorReward), ("vail", BottleneckReward)):
    pair = ("observation", "action")
    register(name, of_pixels(cls, *pair), depends_on=pair, pixels=True)
states = ("observation", "next_observation")
register("copy", copied_pixels, depends_on=states, learned=False, pixels=True)

every_reward = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


@every_reward
def test_one_value_per_transition(case):
    checks.check_one_value_per_transition(case)


@every_reward
def test_batch_shape_does_not_matter(case):
    checks.check_batch_shape_does_not_matter(case)


@every_reward
def test_environments_are_independent(case):
    checks.check_environments_are_independent(case)


@every_reward
def test_depends_on_what_it_says(case):
    checks.check_depends_on_what_it_says(case)


@every_reward
def test_no_gradient_reaches_the_policy(case):
    checks.check_no_gradient_reaches_the_policy(case)


@every_reward
def test_evaluation_leaves_no_trace(case):
    checks.check_evaluation_leaves_no_trace(case)


@every_reward
def test_state_round_trip(case, tmp_path):
    checks.check_state_round_trip(case, tmp_path)


@every_reward
def test_another_device(case):
    checks.check_another_device(case)


@every_reward
def test_nested_keys(case):
    checks.check_nested_keys(case)


@every_reward
def test_environment_and_batch_agree(case, step_counter):
    checks.check_environment_and_batch_agree(case, step_counter)


@every_reward
def test_terminal_step(case, step_counter):
    checks.check_terminal_step(case, step_counter)


# The checks themselves: each wrong reward has to be caught by the check that is there for it.


def reward_of(function):
    return lambda c: TensorDictModule(function, **c.reads())


def batch_mean(s, a, following):
    error = (s - following).square().sum(-1, keepdim=True)
    return error.mean().expand_as(error)


def with_a_look(s, a, following):
    return (s - following).sum(-1, keepdim=True) * (1.0 if s.abs().max() > 1 else 2.0)


def with_a_constant(s, a, following):
    return (s - following).sum(-1, keepdim=True) * torch.ones(1)


class Drifting(CopyReward):
    """Changes a statistic whenever it is used."""

    def forward(self, tensordict):
        self.scaler.offset += 0.1
        return super().forward(tensordict)


class GlobalNoise(NoiseReward):
    """Draws from everybody's generator."""

    def forward(self, tensordict):
        return tensordict.set(self.out_keys[0], torch.rand(*tensordict.batch_size, 1))


WRONG = {
    "averages": (reward_of(batch_mean), "environments_are_independent"),
    "no last dimension": (reward_of(lambda s, a, n: n.sum(-1)), "one_value_per_transition"),
    "reads s for s'": (reward_of(lambda s, a, n: s[..., :1]), "depends_on_what_it_says"),
    "drifts": (
        lambda c: Drifting(ObservationScaler(c.dim), **c.reads("observation", "next_observation")),
        "evaluation_leaves_no_trace",
    ),
    "global noise": (
        lambda c: GlobalNoise(1.0, 1.0, out_keys=c.out_keys),
        "evaluation_leaves_no_trace",
    ),
    "looks at a value": (reward_of(with_a_look), "another_device"),
    "keeps a tensor": (reward_of(with_a_constant), "another_device"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_reward_is_caught(name):
    build, check = WRONG[name]
    case = checks.Case(name, build, False, checks.ENTRIES, deterministic=True, learned=True)
    errors = (AssertionError, DataDependentOutputException, RuntimeError)
    with pytest.raises(errors if check == "another_device" else AssertionError):
        getattr(checks, f"check_{check}")(case)
