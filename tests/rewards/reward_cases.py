"""The rewards that are held to the shared checks, what they claim, and data to check them on."""

import copy
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded, Categorical, TensorSpec

from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.rewards import ObservationScaler

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
    """A reward and what it claims, see :func:`register`."""

    name: str
    build: Callable[[Setting], TensorDictModuleBase]
    discrete: bool
    depends_on: tuple[str, ...]
    deterministic: bool
    learned: bool
    pixels: bool = False

    @property
    def spec(self) -> TensorSpec:
        """The action spec; that of frames is Breakout's."""
        if self.pixels:
            return Categorical(4)
        return Categorical(3) if self.discrete else Bounded(-1.0, 1.0, shape=(1,))


CASES: list[Case] = []


def register(
    name: str,
    build: Callable[[Setting], TensorDictModuleBase],
    *,
    depends_on: tuple[str, ...] = ENTRIES,
    deterministic: bool = True,
    learned: bool = True,
    pixels: bool = False,
) -> None:
    """Adds a reward to the checked ones, for Box and for Discrete actions; of pixels, for Discrete.

    Args:
        name: its name in test ids.
        build: builds it; scalers inside are fitted afterwards.
        depends_on: which entries of a transition its value depends on.
        deterministic: whether equal transitions get equal rewards; a noisy one has to draw from a
            generator of its own, and equal numbers of draws from equal states have to be equal.
        learned: whether it has weights or statistics, which decide its value.
        pixels: whether it reads stacks of frames rather than vectors.
    """
    for discrete in (True,) if pixels else (False, True):
        kind = "pixels" if pixels else "discrete" if discrete else "box"
        claims = (depends_on, deterministic, learned, pixels)
        CASES.append(Case(f"{name}-{kind}", build, discrete, *claims))


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
