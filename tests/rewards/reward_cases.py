"""The rewards that are held to the shared checks, what they claim, and data to check them on."""

import copy
import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from giril_rl.methods import methods
from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.rewards import NoiseReward, ObservationScaler
from giril_rl.rewards.dril import DisagreementConfig
from giril_rl.rewards.method import Method, Scope
from giril_rl.runs.randomness import seeded

DIM = 3
FRAMES = (4, 84, 84)
ENTRIES = ("observation", "action", "next_observation")
PLAIN = {
    "observation": "observation",
    "action": "action",
    "next_observation": ("next", "observation"),
    "reward": ("next", "intrinsic_reward"),
}
NESTED = {
    "observation": ("agent", "seen"),
    "action": ("agent", "done", "action"),
    "next_observation": ("next", "agent", "seen"),
    "reward": ("next", "agent", "paid"),
}


@dataclass(frozen=True)
class Setting:
    """What a reward is built for.

    Attributes:
        spec: the action spec.
        keys: keys by the names in ``ENTRIES``, and ``"reward"``.
        seed: seed of its weights and noise.
    """

    spec: TensorSpec
    keys: dict
    seed: int

    @property
    def dim(self) -> int:
        """Size of the observation."""
        return DIM

    @property
    def out_keys(self) -> list:
        """Where the reward is to be written."""
        return [self.keys["reward"]]

    def reads(self, *entries: str) -> dict:
        """``in_keys`` and ``out_keys`` of a reward that reads these entries; default all three."""
        return {"in_keys": [self.keys[e] for e in entries or ENTRIES], "out_keys": self.out_keys}


@dataclass(frozen=True)
class Case:
    """A reward and what it claims.

    Attributes:
        name: its name in test ids.
        build: builds it; scalers inside are fitted afterwards.
        kind: "box", "discrete" or "pixels", which has Breakout's actions.
        depends_on: which entries of a transition its value depends on; None means all that it
            reads.
        deterministic: whether equal transitions get equal rewards. A noisy one has to draw from a
            generator of its own, and equal numbers of draws from equal states have to be equal.
        takes_keys: whether ``build`` heeds the setting's keys.
        scope: what the value depends on, see :class:`giril_rl.rewards.method.Method`.
    """

    name: str
    build: Callable[[Setting], TensorDictModuleBase]
    kind: str = "box"
    depends_on: tuple[str, ...] | None = None
    deterministic: bool = True
    takes_keys: bool = True
    scope: Scope = "transition"

    @property
    def pixels(self) -> bool:
        """Whether it reads stacks of frames rather than vectors."""
        return self.kind == "pixels"

    @property
    def discrete(self) -> bool:
        """Whether actions are integers."""
        return self.kind != "box"

    @property
    def spec(self) -> TensorSpec:
        """The action spec."""
        return {"box": Bounded(-1.0, 1.0, shape=(1,)), "discrete": Categorical(3)}.get(
            self.kind, Categorical(4)
        )

    def claims(self, module: TensorDictModuleBase) -> tuple[str, ...]:
        """The entries that the module's value depends on."""
        if self.depends_on is not None:
            return self.depends_on
        return tuple(entry for entry in ENTRIES if PLAIN[entry] in module.in_keys)


def registered_cases() -> list[Case]:
    """Every registered reward with its default settings, of each kind of observation and action.

    A new method or control is checked without a line here.
    """
    found = []
    for name, method in methods().items():
        if method.build is None or method.scope == "trajectory":  # Those have checks of their own.
            continue
        kinds = ("box", "discrete", "pixels") if method.kind == "method" else ("box",)
        for kind in kinds[: 2 if not method.frames else 3]:
            build = functools.partial(of_method, method, kind)
            noisy = isinstance(build(Setting(Categorical(4), PLAIN, 0)), NoiseReward)
            case = Case(f"{name}-{kind}", build, kind, None, not noisy, False, method.scope)
            found.append(case)
    return found


def settings_of(method: Method, kind: str) -> Any:
    """A method's default settings, of small networks and for this kind of observation."""
    if method.settings is None:
        return None
    settings = method.settings()
    changes: dict[str, Any] = {"normalise": "pixels"} if kind == "pixels" else {"hidden": [16, 16]}
    if isinstance(settings, DisagreementConfig):
        changes["form"] = "variance"  # A sign hides what it depends on.
    return replace(settings, **{k: v for k, v in changes.items() if hasattr(settings, k)})


def of_method(method: Method, kind: str, setting: Setting) -> TensorDictModuleBase:
    """A registered reward, untrained; a control's is derived of it with moments made up."""
    env = SimpleNamespace(
        action_spec=setting.spec,
        observation_spec={
            "observation": Unbounded(FRAMES, dtype=torch.uint8)
            if kind == "pixels"
            else Unbounded((DIM,))
        },
    )
    pairs = demonstrated(kind, setting)
    reward = method.build(settings_of(method, kind), env, pairs, seed=setting.seed)
    if method.derive is not None:
        reward = method.derive(reward, lambda: (2.0, 0.5), setting.seed)
    return reward


def demonstrated(kind: str, setting: Setting) -> TensorDict:
    """Transitions of a demonstration; observations are those of :func:`demonstration`, seed 0."""
    seen = torch.zeros(2, *FRAMES, dtype=torch.uint8) if kind == "pixels" else demonstration(0)
    with seeded(setting.seed):
        action = setting.spec.rand((len(seen),))
    values = {"observation": seen, "action": action, "next_observation": seen.flip(0)}
    out = TensorDict(batch_size=[len(seen)])
    for name, value in values.items():
        out.set(setting.keys[name], value)
    return out


def build(case: Case, *, seed: int = 0, keys: dict = PLAIN, fit: bool = True):
    """A reward with its scalers fitted to observations that ``seed`` decides."""
    module = case.build(Setting(case.spec, keys, seed))
    observations = demonstration(seed)
    for part in module.modules() if fit else ():
        if isinstance(part, ObservationScaler):
            part.fit(observations)
        if isinstance(part, RunningNormaliser):
            part.update(observations)
    return module


def demonstration(seed: int) -> torch.Tensor:
    """Observations with a spread of about 2 around 1; each seed's are a little different."""
    generator = torch.Generator().manual_seed(seed)
    return (2 + 0.2 * seed) * torch.randn(200, DIM, generator=generator) + 1


def transitions(case: Case, *batch: int, keys: dict = PLAIN, seed: int = 0) -> TensorDict:
    """Random transitions well inside any clamp."""
    generator = torch.Generator().manual_seed(seed)

    def inside(size: int) -> torch.Tensor:
        return torch.rand(*batch, size, generator=generator) * 1.6 - 0.8

    def observe() -> torch.Tensor:
        if case.pixels:
            return torch.randint(256, (*batch, *FRAMES), generator=generator, dtype=torch.uint8)
        return 1 + inside(DIM)

    action = torch.randint(3, batch, generator=generator) if case.discrete else inside(1)
    values = {"observation": observe(), "action": action, "next_observation": observe()}
    out = TensorDict(batch_size=batch)
    for name, value in values.items():
        out.set(keys[name], value)
    # What AIRL reads besides.
    out.set(("next", "terminated"), torch.zeros(*batch, 1, dtype=torch.bool))
    out.set("policy_log_prob", torch.zeros(batch))
    return out


def far_away(case: Case, size: int) -> TensorDict:
    """Transitions between states that no expert saw; of frames, from black to white."""
    far = transitions(case, size)
    for key, sign, colour in (("observation", 1, 0), (("next", "observation"), -1, 255)):
        far[key] = torch.full_like(far[key], colour) if case.pixels else sign * 1e4 * far[key]
    return far


def rewards(module: TensorDictModuleBase, batch: TensorDict, keys: dict = PLAIN) -> torch.Tensor:
    """What the module writes; its noise, if any, is the same at each call."""
    module = copy.deepcopy(module).eval()
    with torch.no_grad():
        return module(batch.clone()).get(keys["reward"])


def assert_equal(actual: torch.Tensor, expected: torch.Tensor) -> None:
    """Equal but for the order of summation, which depends on a batch's shape."""
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-6)
