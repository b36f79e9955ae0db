"""Every registered reward, and variants of its settings, against the shared checks.

A reward that registers itself is checked without a line here; a variant is a line in ``VARIANTS``.
"""

import functools
from dataclasses import replace

import pytest
import reward_checks as checks
import torch
from reward_cases import (
    Case,
    build,
    demonstrated,
    of_method,
    registered_cases,
    settings_of,
    transitions,
)
from reward_data import total
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch._subclasses.fake_tensor import DataDependentOutputException

from giril_rl.methods import methods
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
)
from giril_rl.rewards.airl import AIRLReward
from giril_rl.rewards.dril import DisagreementReward
from giril_rl.rewards.method import GREY, Method, register, unregister
from giril_rl.rewards.mmd import MMDReward
from giril_rl.rewards.nearest import NearestReward
from giril_rl.rewards.red import DistillationReward

PAIR, STATES = ("observation", "action"), ("observation", "next_observation")


def of_vectors(cls, *entries, **kwargs):
    return lambda c: cls.for_vectors(c.dim, c.spec, seed=c.seed, **kwargs, **c.reads(*entries))


def of_pixels(cls, *entries, **kwargs):
    return lambda c: cls.for_pixels(c.spec, seed=c.seed, **kwargs, **c.reads(*entries))


def copied(c):
    return CopyReward(ObservationScaler(c.dim), **c.reads(*STATES))


def airl_of_states(c):
    return AIRLReward.for_vectors(c.dim, c.spec, state_only=True, seed=c.seed, out_keys=c.out_keys)


def copied_pixels(c):
    return CopyReward(PixelScaler(), **c.reads(*STATES))


def centred(c):
    return AffineReward(of_vectors(GenerativeReward, hidden=[16], beta=0.9)(c), shift=-0.3)


def of_points(cls, kind="box", **kwargs):
    def build(c):
        pairs = demonstrated(kind, c)
        common = {"atoms": len(pairs), "seed": c.seed, **kwargs, **c.reads()}
        make = cls.for_pixels if kind == "pixels" else functools.partial(cls.for_vectors, c.dim)
        reward = make(c.spec, **common)
        reward.remember(pairs)
        if cls is MMDReward:
            visits = transitions(Case("visits", build, kind), 9, keys=c.keys, seed=5)
            reward.observe(visits)
        return reward

    return build


GIRIL = functools.partial(of_vectors, GenerativeReward, hidden=[16, 16])
GAIL = functools.partial(of_vectors, DiscriminatorReward, *PAIR, hidden=[16, 16])
VAIL = functools.partial(of_vectors, BottleneckReward, *PAIR, hidden=[16, 16], latent=4)
DRIL = {"hidden": [16], "variance": "state", "form": "variance"}
# Clamped raw observations would stop at 1, in the middle of the checks' data.
RAW = {"normalise": "raw", "clamp": False}
VARIANTS = [
    Case("giril-min-max-conditional", GIRIL(normalise="demo_range", prior="conditional")),
    Case("giril-noise", GIRIL(beta=0.9, prior="conditional"), deterministic=False),
    Case("giril-raw", GIRIL(**RAW), "discrete"),
    Case("icm-min-max", of_vectors(CuriosityReward, normalise="demo_range"), "discrete"),
    Case("icm-no-features", of_vectors(CuriosityReward, hidden=[], **RAW)),
    Case("gail-running-negative", GAIL(normalise="running", form="negative")),
    Case("gail-min-max-log_ratio", GAIL(normalise="demo_range", form="log_ratio"), "discrete"),
    Case("gail-raw-reversed", GAIL(normalise="raw", form="reversed")),
    Case("vail-running-reversed", VAIL(normalise="running", form="reversed"), "discrete"),
    Case("gail-absorbing", GAIL(absorbing=True)),
    Case("vail-absorbing-pixels", of_pixels(BottleneckReward, *PAIR, absorbing=True), "pixels"),
    Case("airl-state-only", airl_of_states, "box", STATES, takes_keys=False),
    Case("giril-states", GIRIL(use_actions=False), depends_on=STATES, deterministic=False),
    Case("icm-states", of_vectors(CuriosityReward, use_actions=False), "discrete"),
    Case("gail-states", GAIL(use_actions=False)),
    Case("vail-states", VAIL(use_actions=False), "discrete"),
    Case("red-states", of_vectors(DistillationReward, *PAIR, use_actions=False), "discrete"),
    Case("nearest-gaussian", of_points(NearestReward, kernel="gaussian")),
    Case("nearest-raw-next", of_points(NearestReward, normalise="raw", use_next=True)),
    Case("nearest-states", of_points(NearestReward, use_actions=False, clamp=None)),
    Case("mmd-next", of_points(MMDReward, use_next=True, every=1)),
    Case("mmd-states", of_points(MMDReward, use_actions=False, use_next=True), "box", STATES),
    Case("mmd-pixels-states", of_points(MMDReward, "pixels", use_actions=False), "pixels"),
    Case("dril-state", of_vectors(DisagreementReward, *PAIR, **DRIL), "box", ("observation",)),
    Case("copy", copied),
    Case("constant", lambda c: ConstantReward(2.0, out_keys=c.out_keys)),
    Case(
        "noise",
        lambda c: NoiseReward(2.0, 0.5, seed=c.seed, out_keys=c.out_keys),
        deterministic=False,
    ),
    Case("centred-giril-noise", centred, deterministic=False),
    Case("giril-pixels-noise", of_pixels(GenerativeReward, beta=0.9), "pixels", None, False),
    Case("gail-pixels", of_pixels(DiscriminatorReward, *PAIR, form="negative"), "pixels"),
    Case("copy-pixels", copied_pixels, "pixels"),
    Case(
        "giril-pixels-states",
        of_pixels(GenerativeReward, use_actions=False),
        "pixels",
        deterministic=False,
    ),
    Case("icm-pixels-states", of_pixels(CuriosityReward, use_actions=False), "pixels"),
    Case("gail-pixels-states", of_pixels(DiscriminatorReward, *PAIR, use_actions=False), "pixels"),
    Case("vail-pixels-states", of_pixels(BottleneckReward, *PAIR, use_actions=False), "pixels"),
    Case("red-pixels-states", of_pixels(DistillationReward, *PAIR, use_actions=False), "pixels"),
]
CASES = [*registered_cases(), *VARIANTS]
WITH_KEYS = [case for case in CASES if case.takes_keys]
TRAINED = [name for name, method in methods().items() if method.loss and method.build]

every_reward = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
of_transitions = pytest.mark.parametrize(
    "case", [case for case in CASES if case.scope == "transition"], ids=lambda case: case.name
)


@every_reward
def test_one_value_per_transition(case):
    checks.check_one_value_per_transition(case)


@of_transitions
def test_batch_shape_does_not_matter(case):
    checks.check_batch_shape_does_not_matter(case)


@of_transitions
def test_environments_are_independent(case):
    checks.check_environments_are_independent(case)


@of_transitions
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


@pytest.mark.parametrize("case", WITH_KEYS, ids=lambda case: case.name)
def test_nested_keys(case):
    checks.check_nested_keys(case)


@of_transitions
def test_environment_and_batch_agree(case, step_counter):
    checks.check_environment_and_batch_agree(case, step_counter)


@of_transitions
def test_terminal_step(case, step_counter):
    checks.check_terminal_step(case, step_counter)


# Registered methods


@pytest.mark.parametrize("name", TRAINED)
def test_a_registered_loss_trains_its_reward(name):
    method = replace(methods()[name], derive=None)
    case = Case(name, functools.partial(of_method, method, "box"))
    reward, batch = build(case), transitions(case, 8)
    loss = method.loss(reward, settings_of(method, "box"))
    if method.trained == "beside":
        batch = TensorDict({"expert": batch[:3], "policy": batch[3:]})
    out = loss(batch)
    assert set(out.keys()) == set(loss.out_keys) and total(out).isfinite()
    total(out).backward()
    assert any(p.grad is not None and p.grad.any() for p in reward.parameters())


def test_a_newly_registered_reward_is_picked_up():
    method = register(
        Method(
            "control:half",
            "half",
            GREY,
            kind="control",
            build=lambda settings, env, pairs, *, seed: ConstantReward(0.5),
        )
    )
    try:
        assert "control:half-box" in [case.name for case in registered_cases()]
    finally:
        unregister(method.name)


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
    case = Case(name, build, depends_on=checks.ENTRIES)
    errors = (AssertionError, DataDependentOutputException, RuntimeError)
    with pytest.raises(errors if check == "another_device" else AssertionError):
        getattr(checks, f"check_{check}")(case)
