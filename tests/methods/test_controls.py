import pytest
import torch
from tensordict import TensorDict

from giril_rl.config.schema import DemoConfig, FitConfig, SACConfig, TaskConfig
from giril_rl.demos import Demonstration
from giril_rl.envs import make_env
from giril_rl.methods import ControlRunConfig
from giril_rl.methods.controls import control_reward, moments
from giril_rl.rewards import (
    AffineReward,
    ConstantReward,
    CopyReward,
    CuriosityConfig,
    CuriosityReward,
    GenerativeConfig,
    GenerativeReward,
    NoiseReward,
)
from giril_rl.runs.metrics import read_metrics
from giril_rl.runs.randomness import stream_seed
from giril_rl.runs.run import Run

TASK = TaskConfig(name="cartpole", env_id="CartPole-v1")


@pytest.fixture(scope="module")
def env():
    return make_env(TASK, 1, seed=0)


@pytest.fixture(scope="module")
def demo():
    generator = torch.Generator().manual_seed(0)
    data = {
        "observation": torch.randn(60, 4, generator=generator),
        "action": torch.randint(2, (60,), generator=generator),
        "next": {"observation": torch.randn(60, 4, generator=generator)},
    }
    return Demonstration(TensorDict(data, [60]))


def config(reward, **kwargs):
    return ControlRunConfig(
        task=TASK,
        steps=2000,
        reward=reward,
        seed=7,
        demo=DemoConfig(subsample=3),
        fit=FitConfig(steps=20, batch=8, lr=1e-2, log_every=10),
        **{"giril": GenerativeConfig(hidden=[8]), "icm": CuriosityConfig(hidden=[8]), **kwargs},
    )


def made(cfg, env, demo, folder):
    with Run.open(folder, {}, recipe="x") as run:
        return control_reward(cfg, env, demo, run)


def weights(module):
    return {k: v for k, v in module.state_dict().items() if not k.endswith("_extra_state")}


def same(one, other):
    one, other = weights(one), weights(other)
    return one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)


def test_a_constant_needs_no_demonstration(env, tmp_path):
    cfg = config("constant")
    reward, seeds = made(cfg, env, None, tmp_path)
    assert isinstance(reward, ConstantReward) and reward.value == 1 and seeds == {}
    needed = {r for r in ("constant", "copy", "noise", "random") if config(r).needs_demonstration}
    assert needed == {"copy", "noise"}


def test_in_the_replay_buffer_a_control_has_the_demonstration_that_a_method_has():
    kinds = ("constant", "copy", "entropy_bonus", "random")
    off_policy = {r for r in kinds if config(r, algorithm="sac").needs_demonstration}
    assert off_policy == {"constant", "copy", "entropy_bonus"}
    without = SACConfig(demonstration="none")
    assert not config("constant", algorithm="sac", sac=without).needs_demonstration


@pytest.mark.parametrize(
    ("name", "kind", "part"),
    [
        ("untrained_giril", GenerativeReward, "giril"),
        ("untrained_icm", CuriosityReward, "icm"),
    ],
)
def test_untrained_modules_are_fresh_but_know_the_demonstration(
    name, kind, part, env, demo, tmp_path
):
    reward, seeds = made(config(name), env, demo, tmp_path)
    assert type(reward) is kind
    fresh = kind.for_vectors(4, env.action_spec, hidden=[8], seed=stream_seed("reward", 7))
    fresh.scaler.fit(demo.transitions["observation"][::3])
    assert same(reward, fresh)
    assert seeds == {"reward": 7}
    assert not read_metrics(tmp_path / "metrics.jsonl")
    own = {"giril": GenerativeConfig, "icm": CuriosityConfig}[part](hidden=[8], seed=3)
    other, seeds = made(config(name, **{part: own}), env, demo, tmp_path / "other")
    assert seeds["reward"] == 3 and not same(reward, other)


def test_copy_by_hand(env, demo, tmp_path):
    giril = GenerativeConfig(normalise="demo_range", clamp=True, scale=2.0)
    reward, seeds = made(config("copy", giril=giril), env, demo, tmp_path)
    assert isinstance(reward, CopyReward) and seeds == {}
    s, following = demo.transitions["observation"], demo.transitions["next", "observation"]
    low, high = s[::3].amin(0), s[::3].amax(0)
    s, following = ((2 * (x - low) / (high - low) - 1).clamp(-1, 1) for x in (s, following))
    expected = 2 * (s - following).square().sum(-1, keepdim=True)
    torch.testing.assert_close(
        reward(demo.transitions.clone())["next", "intrinsic_reward"], expected
    )


def test_fitted_ones_are_matched_on_the_kept_transitions(env, demo, tmp_path):
    negated, _ = made(config("negated_giril"), env, demo, tmp_path / "negated")
    centred, _ = made(config("centred_giril"), env, demo, tmp_path / "centred")
    noise, seeds = made(config("noise"), env, demo, tmp_path / "noise")
    assert isinstance(negated, AffineReward) and isinstance(centred, AffineReward)
    assert isinstance(noise, NoiseReward) and seeds["reward"] == 7
    # The same fit in all three, and a fit it was.
    assert same(negated.module, centred.module)
    untrained, _ = made(config("untrained_giril"), env, demo, tmp_path / "untrained")
    assert not same(negated.module, untrained)
    for name in ("negated", "centred", "noise"):
        fit = [r for r in read_metrics(tmp_path / name / "metrics.jsonl") if r["phase"] == "fit"]
        assert [row["step"] for row in fit] == [10, 20]
        assert "fit/held_out/kl" in fit[0]

    def values(module):
        out = module(demo.transitions.clone())["next", "intrinsic_reward"].detach()
        assert out.shape == (60, 1)
        return out

    plain = values(negated.module)
    assert torch.equal(values(negated), -plain)
    mean, variance = plain[::3].mean().item(), plain[::3].var(correction=0).item()
    torch.testing.assert_close(values(centred), plain - mean)
    assert values(centred)[::3].mean().item() == pytest.approx(0, abs=1e-5)
    assert noise.mean.item() == pytest.approx(mean, rel=1e-5)
    assert noise.variance.item() == pytest.approx(variance, rel=1e-4)
    # They are on record, once, also when the run is continued.
    made(config("noise"), env, demo, tmp_path / "noise")
    rows = read_metrics(tmp_path / "noise" / "metrics.jsonl")
    (row,) = [row for row in rows if row["phase"] == "moments"]
    assert row["moments/mean"] == pytest.approx(mean, rel=1e-5)
    assert row["moments/variance"] == pytest.approx(variance, rel=1e-4)


def test_moments_leave_the_demonstration_alone(demo):
    before = demo.transitions.clone()
    assert moments(ConstantReward(2.0), demo.transitions) == (2.0, 0.0)
    assert set(demo.transitions.keys(True, True)) == set(before.keys(True, True))
