import pytest
import torch
from short_runs import Killed, stopped
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical

from giril_rl.config.schema import FitConfig
from giril_rl.errors import UserError
from giril_rl.rewards import (
    CuriosityReward,
    CuriosityRewardLoss,
    GenerativeReward,
    GenerativeRewardLoss,
)
from giril_rl.runs.interrupt import Interrupted
from giril_rl.runs.metrics import read_metrics
from giril_rl.runs.run import Run
from giril_rl.training import fitting

SPECS = {"box": Bounded(-1, 1, shape=(1, 1)), "discrete": Categorical(3, shape=(1,))}
TERMS = ("reconstruction", "kl", "action")


def transitions(n, seed=0, kind="box"):
    """The next state tells the action: ``s' = s + a`` in the first dimension."""
    generator = torch.Generator().manual_seed(seed)
    observation = torch.rand(n, 3, generator=generator) - 0.5
    if kind == "discrete":
        action = torch.randint(3, (n,), generator=generator)
        push = action.unsqueeze(-1).float() - 1
    else:
        action = push = 2 * torch.rand(n, 1, generator=generator) - 1
    following = observation + 0.5 * torch.cat([push, torch.zeros(n, 2)], 1)
    entries = {"observation": observation, "action": action}
    return TensorDict({**entries, "next": {"observation": following}}, [n])


def fitted(folder, *, kind="box", data=None, held_out=None, seed=0, model_seed=0, **kwargs):
    """Fits a new model; its weights and the rows of the log."""
    cfg = FitConfig(**{"steps": 60, "batch": 16, "lr": 3e-3, "log_every": 10, **kwargs})
    reward = GenerativeReward.for_vectors(
        3, SPECS[kind], hidden=[16], normalise="raw", clamp=False, seed=model_seed
    )
    data = transitions(100, kind=kind) if data is None else data
    loss = GenerativeRewardLoss(reward)
    with Run.open(folder, {}, recipe="x") as run:
        fitting.fit_reward(loss, data, cfg, seed=seed, run=run, validation=held_out)
    return dict(loss.named_parameters()), read_metrics(folder / "metrics.jsonl")


def same(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("kind", SPECS)
def test_the_losses_fall_on_fitted_and_held_out_data(kind, tmp_path):
    held_out = transitions(50, seed=9, kind=kind)
    _, rows = fitted(tmp_path, kind=kind, held_out=held_out, steps=300)
    assert {row["phase"] for row in rows} == {"fit"}
    assert [row["step"] for row in rows] == list(range(10, 301, 10))
    for name in ("fitted", "held_out"):
        total = [sum(row[f"fit/{name}/{term}"] for term in TERMS) for row in rows]
        assert total[-1] < 0.8 * total[0]


def test_how_often_losses_are_logged_changes_nothing_else(tmp_path):
    one, other = (fitted(tmp_path / str(every), log_every=every) for every in (7, 60))
    assert same(one[0], other[0]) and len(one[1]) > len(other[1])


def test_held_out_data_are_logged_and_never_fitted(tmp_path):
    held_out = transitions(50, seed=9)
    weights, rows = fitted(tmp_path / "a", held_out=held_out)
    other_weights, other_rows = fitted(tmp_path / "b", held_out=held_out.apply(lambda x: x * 3))
    none_weights, none_rows = fitted(tmp_path / "c")
    empty_weights, _ = fitted(tmp_path / "d", held_out=held_out[:0])
    assert same(weights, other_weights)
    assert same(weights, none_weights)
    assert same(weights, empty_weights)
    for row, other, none in zip(rows, other_rows, none_rows, strict=True):
        for term in TERMS:
            key = f"fit/fitted/{term}"
            assert row[key] == other[key] == none[key]
        key = "fit/held_out/reconstruction"
        assert row[key] != other[key]
        assert key not in none


def test_logged_losses_are_those_of_the_whole_set(tmp_path):
    data = transitions(40)
    weights, rows = fitted(tmp_path, data=data, steps=10)
    reward = GenerativeReward.for_vectors(3, SPECS["box"], hidden=[16], normalise="raw")
    reward.scaler.clamp = False
    loss = GenerativeRewardLoss(reward)
    loss.load_state_dict(weights, strict=False)
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        expected = loss(data)
    for term in TERMS:
        assert rows[-1][f"fit/fitted/{term}"] == pytest.approx(expected[f"loss_{term}"].item())


def test_seeds_and_data_decide_everything(tmp_path):
    torch.manual_seed(77)
    first, _ = fitted(tmp_path / "first")
    torch.manual_seed(78)
    again, _ = fitted(tmp_path / "again")
    assert same(first, again)
    # Noise and minibatches, at the same initial weights.
    assert not same(first, fitted(tmp_path / "seed", seed=1)[0])
    assert not same(first, fitted(tmp_path / "model", model_seed=1)[0])
    assert not same(first, fitted(tmp_path / "data", data=transitions(100, seed=1))[0])
    # How often is logged decides nothing.
    assert same(first, fitted(tmp_path / "log", log_every=7)[0])


@pytest.mark.parametrize("log_every", [10, 7])
def test_a_fit_stopped_again_and_again_ends_bit_for_bit_as_an_undisturbed_one(
    log_every, tmp_path, monkeypatch
):
    monkeypatch.setattr(fitting, "CHECKPOINT_EVERY", 20)
    held_out = transitions(20, seed=5)
    weights, rows = fitted(tmp_path / "whole", held_out=held_out, log_every=log_every)
    stops = [(1, Killed), (1, Interrupted), (4, Killed), (5, Interrupted), (6, Killed)]
    stops.append((60 / log_every, Interrupted))  # At the last step.
    for number, how in stops:
        with stopped(how, number * log_every):
            fitted(tmp_path / "run", held_out=held_out, log_every=log_every)
        torch.manual_seed(99)
    found, found_rows = fitted(tmp_path / "run", held_out=held_out, log_every=log_every)
    assert same(found, weights)
    assert found_rows == rows
    assert rows[-1]["step"] == 60


def test_a_finished_fit_is_only_loaded(tmp_path):
    weights, rows = fitted(tmp_path)
    before = (tmp_path / "fit.safetensors").stat().st_mtime_ns
    again, same_rows = fitted(tmp_path, model_seed=5)
    assert same(weights, again)
    assert rows == same_rows
    assert (tmp_path / "fit.safetensors").stat().st_mtime_ns == before


def test_no_steps_leave_the_model_as_it_is(tmp_path):
    weights, rows = fitted(tmp_path, steps=0)
    fresh = GenerativeReward.for_vectors(3, SPECS["box"], hidden=[16], seed=0)
    assert same(weights, dict(GenerativeRewardLoss(fresh).named_parameters()))
    assert rows == []


# Models of pixels, which normalise by batch


def pixel_loss():
    return CuriosityRewardLoss(CuriosityReward.for_pixels(SPECS["discrete"], seed=0))


def frames(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    s, following = torch.randint(256, (2, n, 4, 84, 84), generator=generator, dtype=torch.uint8)
    action = torch.randint(3, (n,), generator=generator)
    return TensorDict({"observation": s, "action": action, "next": {"observation": following}}, [n])


def fit_frames(folder, *, loss=None, held_out=None, **kwargs):
    """Fits a new model to 8 transitions; all that it holds, and the rows of the log."""
    cfg = FitConfig(**{"steps": 6, "batch": 4, "lr": 1e-3, "log_every": 2, **kwargs})
    loss = pixel_loss() if loss is None else loss
    with Run.open(folder, {}, recipe="x") as run:
        fitting.fit_reward(loss, frames(8), cfg, seed=0, run=run, validation=held_out)
    return dict(loss.state_dict()), read_metrics(folder / "metrics.jsonl")


def test_batch_normalisation_learns_in_steps_and_nowhere_else(tmp_path):
    loss, modes = pixel_loss(), []
    (first, *_) = [part for part in loss.modules() if isinstance(part, nn.BatchNorm2d)]
    first.register_forward_pre_hook(lambda part, inputs: modes.append(part.training))
    state, _ = fit_frames(tmp_path / "both", loss=loss, held_out=frames(3, seed=1))
    # For s and s', two steps of training and then the two sets that are logged.
    assert modes == 3 * (2 * [True, True] + 2 * [False, False])
    assert not any(part.training for part in loss.modules())
    assert first.num_batches_tracked == 2 * 6
    alone, _ = fit_frames(tmp_path / "alone", log_every=6)
    assert all(torch.equal(value, alone[name]) for name, value in state.items())


def test_a_finished_or_empty_fit_leaves_the_model_in_eval_mode(tmp_path):
    fit_frames(tmp_path / "run", steps=2)
    for folder, steps in (("run", 2), ("empty", 0)):
        loss = pixel_loss().train()
        fit_frames(tmp_path / folder, loss=loss, steps=steps)
        assert not any(part.training for part in loss.modules())


def test_the_logged_loss_of_frames_is_that_of_eval_mode(tmp_path):
    loss = pixel_loss()
    _, found = fit_frames(tmp_path, loss=loss)
    with torch.no_grad():
        evaluated = loss.eval()(frames(8))
        normalised_by_the_batch = loss.train()(frames(8))
    for term in ("inverse", "forward"):
        logged = found[-1][f"fit/fitted/{term}"]
        assert logged == pytest.approx(evaluated[f"loss_{term}"].item(), rel=1e-5)
        assert logged != pytest.approx(normalised_by_the_batch[f"loss_{term}"].item(), rel=1e-2)


@pytest.mark.parametrize("compile", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_fit_of_frames_is_resumed_bit_for_bit_with_its_statistics(compile, tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "CHECKPOINT_EVERY", 4)
    expected, expected_rows = fit_frames(tmp_path / "whole", compile=compile)
    for step, how in ((2, Interrupted), (6, Killed)):
        with stopped(how, step):
            fit_frames(tmp_path / "run", compile=compile)
        torch.manual_seed(99)
    found, found_rows = fit_frames(tmp_path / "run", compile=compile)
    assert found.keys() == expected.keys()
    assert any(name.endswith("running_var") for name in found)
    for name, value in expected.items():
        assert torch.equal(found[name], value), name
    assert found_rows == expected_rows


def test_transitions_that_do_not_fit_the_reward_are_refused(tmp_path):
    with pytest.raises(UserError, match="the batch has no 'action'"):
        fitted(tmp_path, data=transitions(20).exclude("action"))
    wrong = transitions(20, kind="discrete").set("action", torch.full((20,), 3))
    with pytest.raises(UserError, match=r"the demonstration's action at index \[0\] is 3"):
        fitted(tmp_path, kind="discrete", data=wrong)
