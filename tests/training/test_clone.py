import pytest
import torch
import torch.nn.functional as F
from short_runs import Killed, stopped
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.envs.utils import ExplorationType, set_exploration_type

from giril_rl.config.schema import BCConfig
from giril_rl.errors import UserError
from giril_rl.policies.actor_critic import NORMALISED, ActorCritic
from giril_rl.runs.checkpoint import load_state
from giril_rl.runs.interrupt import Interrupted
from giril_rl.runs.metrics import read_metrics
from giril_rl.runs.run import Run
from giril_rl.training import cloning
from giril_rl.training.cloning import clone_behaviour

BOX, DISCRETE = Bounded(-1, 1, shape=(1, 2)), Categorical(3, shape=(1,))
GAIN = torch.tensor([[0.3, -0.2], [0.1, 0.4], [0.0, 0.2]])


def pairs(n, seed=0, *, noise=0.0, spec=BOX):
    """A linear expert: the action is ``GAIN`` times the state, or the largest of its entries."""
    generator = torch.Generator().manual_seed(seed)
    state = 2 * torch.rand(n, 3, generator=generator) - 1
    if spec is DISCRETE:
        scores = state + noise * torch.randn(n, 3, generator=generator)
        return TensorDict({"observation": state, "action": scores.argmax(-1)}, [n])
    action = state @ GAIN + noise * torch.randn(n, 2, generator=generator)
    return TensorDict({"observation": state, "action": action}, [n])


def one_hot(data):
    return F.one_hot(data["action"], 3)


def make_agent(spec=BOX, hidden=(16,), **kwargs):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return ActorCritic(3, spec, hidden=hidden, **kwargs)


def cloned(folder, fitted=None, held_out=None, *, agent=None, seed=0, spec=BOX, **kwargs):
    """A cloned agent and the rows of its log."""
    settings = {"steps": 60, "lr": 2e-2, "weight_decay": 0.0, "log_every": 10, **kwargs}
    agent = make_agent(spec) if agent is None else agent
    fitted = pairs(40, spec=spec) if fitted is None else fitted
    with Run.open(folder, {}, recipe="x") as run:
        cfg = BCConfig(**settings)
        trained = clone_behaviour(agent, fitted, cfg, seed=seed, run=run, validation=held_out)
    assert trained.steps == 0 and trained.seconds > 0
    return agent, read_metrics(folder / "metrics.jsonl")


def mean_action(agent, observation):
    with torch.no_grad():
        return agent.actor(agent.normaliser(observation))


def same(one, other):
    return all(torch.equal(one.state_dict()[k], v) for k, v in other.state_dict().items())


# What is learned


def test_a_linear_expert_is_recovered_from_aligned_pairs(tmp_path):
    """Without a hidden layer the answer is known: the gain itself, whatever the normalisation."""
    agent = make_agent(hidden=())
    cloned(tmp_path, stop="fixed", steps=1500, agent=agent)
    weight = agent.actor[0].weight * agent.normaliser.factor
    torch.testing.assert_close(weight.T, GAIN, atol=1e-3, rtol=0)
    fresh = pairs(100, seed=5)
    torch.testing.assert_close(
        mean_action(agent, fresh["observation"]), fresh["action"], atol=1e-3, rtol=0
    )


def test_bounds_give_the_units(tmp_path):
    """Thousands and hundredths, off centre: the very same fit, in units of half the range."""
    plain, rows = cloned(tmp_path / "plain", pairs(40, noise=0.1), stop="fixed", min_std=0.2)
    low, high = torch.tensor([-2000.0, 0.5]), torch.tensor([2000.0, 0.75])
    agent = make_agent(Bounded(low, high))
    fitted = pairs(40, noise=0.1)
    fitted["action"] = (low + high) / 2 + (high - low) / 2 * fitted["action"]
    _, scaled_rows = cloned(tmp_path / "scaled", fitted, agent=agent, stop="fixed", min_std=0.2)
    for name, value in plain.state_dict().items():
        torch.testing.assert_close(agent.state_dict()[name], value, atol=1e-4, rtol=0)
    assert scaled_rows[-1]["bc/fitted/loss"] == pytest.approx(rows[-1]["bc/fitted/loss"], rel=1e-3)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        played = agent.acting()(fitted.clone())["action"]
    expected = mean_action(plain, fitted["observation"]).clamp(-1, 1)
    expected = (low + high) / 2 + (high - low) / 2 * expected
    torch.testing.assert_close(played, expected, atol=0.0, rtol=1e-3)


def test_actions_one_step_late_are_not_recovered(tmp_path):
    """The fault that the paper's loader had: the same pairs with labels of their neighbours."""
    late = pairs(40)
    late["action"] = late["action"].roll(1, 0)
    agent, _ = cloned(tmp_path, late, stop="fixed", steps=400, agent=make_agent(hidden=()))
    fresh = pairs(100, seed=5)
    wrong = F.mse_loss(mean_action(agent, fresh["observation"]), fresh["action"])
    assert wrong > 0.5 * fresh["action"].square().mean()


def test_discrete_actions_are_recovered(tmp_path):
    fitted = pairs(150, spec=DISCRETE)
    agent, rows = cloned(tmp_path, fitted, stop="fixed", steps=300, batch=150, spec=DISCRETE)
    fresh = pairs(200, seed=5, spec=DISCRETE)
    hits = mean_action(agent, fresh["observation"]).argmax(-1) == fresh["action"]
    assert hits.float().mean() > 0.9
    assert rows[-1]["bc/fitted/loss"] < 0.2 < rows[0]["bc/fitted/loss"]
    assert agent.log_std is None
    # To a policy of one-hot actions the same is taught by integers, as demonstrations have them.
    for number, given in enumerate((fitted, fitted.clone().set("action", one_hot(fitted)))):
        other, _ = cloned(
            tmp_path / f"{number}", given, stop="fixed", steps=20, agent=make_agent(OneHot(3))
        )
        same_steps, _ = cloned(
            tmp_path / f"{number}b", fitted, stop="fixed", steps=20, spec=DISCRETE
        )
        assert same(other, same_steps)


@pytest.mark.parametrize("spec", [BOX, DISCRETE], ids=["box", "discrete"])
def test_the_loss_is_squared_error_or_cross_entropy_of_the_whole_set(spec, tmp_path):
    fitted, held_out = pairs(40, spec=spec), pairs(30, seed=1, spec=spec)
    agent, rows = cloned(tmp_path, fitted, held_out, stop="fixed", steps=10, spec=spec)
    loss = F.cross_entropy if spec is DISCRETE else F.mse_loss
    for name, data in (("fitted", fitted), ("held_out", held_out)):
        expected = loss(mean_action(agent, data["observation"]), data["action"]).item()
        assert rows[-1][f"bc/{name}/loss"] == pytest.approx(expected, rel=1e-5)


def test_only_the_actor_learns(tmp_path):
    before = make_agent()
    agent, _ = cloned(tmp_path, stop="fixed")
    for one, other in zip(agent.critic.parameters(), before.critic.parameters(), strict=True):
        assert torch.equal(one, other)
    assert not torch.equal(agent.actor[0].weight, before.actor[0].weight)


def test_one_step_by_hand(tmp_path):
    """Adam's first step is the step size in the gradient's direction, beside the decay."""
    agent = make_agent(hidden=())
    before = agent.actor[0].weight.detach().clone()
    cloned(tmp_path, stop="fixed", steps=1, lr=0.01, weight_decay=3.0, agent=agent)
    fitted = pairs(40)
    scaled = (fitted["observation"] - fitted["observation"].mean(0)) * agent.normaliser.factor
    error = scaled @ before.T - fitted["action"]  # The bias is 0 at first.
    expected = before * (1 - 0.01 * 3.0) - 0.01 * (error.T @ scaled).sign()
    torch.testing.assert_close(agent.actor[0].weight.detach(), expected, atol=1e-6, rtol=0)


def test_the_step_size_decreases_to_zero(tmp_path):
    cloned(tmp_path, stop="fixed", steps=50, lr=0.5)
    state = load_state(tmp_path / "bc.safetensors")
    assert state["fit"]["optimizer"]["param_groups"][0]["lr"] == pytest.approx(0.5 / 50)


# Normalisation and deviation


def test_observations_are_normalised_by_the_fitted_pairs_alone(tmp_path):
    fitted = pairs(40)
    fitted["observation"][:, 1] = 7.0 + 1e-3 * fitted["observation"][:, 1]  # hardly moves
    agent, _ = cloned(tmp_path, fitted, pairs(30, seed=1), min_scale=0.1)
    observation = fitted["observation"]
    scale = observation.std(0, correction=0)
    assert scale[1] < 1e-3 and scale[0] > 0.1
    scale[1] = 0.1
    expected = (observation - observation.mean(0)) / scale
    torch.testing.assert_close(agent.normaliser(observation), expected, atol=1e-4, rtol=1e-4)
    bare = make_agent(normalise=False)
    cloned(tmp_path / "bare", fitted, stop="fixed", agent=bare)
    assert torch.equal(bare.normaliser(observation), observation)


def test_the_deviation_is_that_of_what_is_left_over(tmp_path):
    """The expert's noise of 0.2, seen on the held-out pairs and not on the fitted few."""
    held_out = pairs(500, seed=1, noise=0.2)
    agent, _ = cloned(tmp_path / "a", pairs(12, noise=0.2), held_out, steps=300)
    error = mean_action(agent, held_out["observation"]) - held_out["action"]
    expected = error.square().mean(0).sqrt()
    torch.testing.assert_close(agent.log_std.exp(), expected, rtol=1e-4, atol=0)
    assert (expected > 0.18).all()
    # It is where the likelihood of those pairs is greatest.
    data = TensorDict({NORMALISED: agent.normaliser(held_out["observation"])}, [500])

    def likelihood(shift):
        with torch.no_grad():
            agent.log_std.add_(shift)
            value = agent.actor_for_loss().get_dist(data).log_prob(held_out["action"]).mean()
            agent.log_std.sub_(shift)
        return value

    assert likelihood(0.0) > likelihood(0.05) and likelihood(0.0) > likelihood(-0.05)
    fixed, _ = cloned(
        tmp_path / "b", pairs(12, noise=0.2), held_out, stop="fixed", steps=600, min_std=0.03
    )
    assert torch.allclose(fixed.log_std.exp(), torch.tensor(0.03))  # all 12 are met


# Stopping

NOISE = 0.1


def noisy(folder, **kwargs):
    """Few noisy pairs: the held-out loss falls, then rises while the fitted one falls on."""
    return cloned(
        folder,
        pairs(10, noise=NOISE),
        pairs(200, seed=1, noise=NOISE),
        agent=make_agent(hidden=(64,)),
        **{"steps": 400, **kwargs},
    )


def test_early_stopping_leaves_the_weights_that_are_best_on_held_out_pairs(tmp_path):
    agent, rows = noisy(tmp_path / "held_out", log_every=1, steps=150)
    losses = [row["bc/held_out/loss"] for row in rows]
    best = min(range(len(rows)), key=losses.__getitem__)
    assert losses[0] > 1.2 * losses[best] < losses[-1] and 0 < best < len(rows) - 5
    held_out = pairs(200, seed=1, noise=NOISE)
    found = F.mse_loss(mean_action(agent, held_out["observation"]), held_out["action"])
    assert found.item() == pytest.approx(losses[best], rel=1e-5)
    last, _ = noisy(tmp_path / "fixed", stop="fixed", log_every=50, steps=150)
    found = F.mse_loss(mean_action(last, held_out["observation"]), held_out["action"])
    assert found.item() == pytest.approx(losses[-1], rel=1e-5)
    assert not torch.equal(last.actor[0].weight, agent.actor[0].weight)


def test_held_out_pairs_are_never_fitted(tmp_path):
    one, _ = cloned(tmp_path / "a", held_out=pairs(30, seed=1), stop="fixed")
    two, _ = cloned(tmp_path / "b", held_out=pairs(30, seed=2), stop="fixed")
    three, rows = cloned(tmp_path / "c", stop="fixed")
    assert same(one, two) and same(one, three)
    assert "bc/held_out/loss" not in rows[0]


def test_nothing_to_hold_out_is_refused(tmp_path):
    for held_out in (None, pairs(30)[:0]):
        with pytest.raises(UserError, match=r"^bc\.stop=held_out has no held-out .*=fixed\.$"):
            cloned(tmp_path, held_out=held_out)


# Repeating and resuming


def test_seeds_and_data_decide_everything(tmp_path):
    torch.manual_seed(77)
    first, _ = cloned(tmp_path / "first", stop="fixed", batch=8)
    torch.manual_seed(78)
    again, _ = cloned(tmp_path / "again", stop="fixed", batch=8)
    assert same(first, again)
    assert not same(first, cloned(tmp_path / "seed", stop="fixed", batch=8, seed=1)[0])
    assert same(first, cloned(tmp_path / "log", stop="fixed", batch=8, log_every=7)[0])
    # Where all pairs are taken at once there is nothing to draw.
    whole, _ = cloned(tmp_path / "whole", stop="fixed", batch=40)
    assert same(whole, cloned(tmp_path / "whole1", stop="fixed", batch=40, seed=1)[0])


@pytest.mark.parametrize("stop", ["held_out", "fixed"])
def test_a_cloning_stopped_again_and_again_ends_bit_for_bit_as_an_undisturbed_one(
    stop, tmp_path, monkeypatch
):
    monkeypatch.setattr(cloning, "CHECKPOINT_EVERY", 20)
    settings = {"stop": stop, "batch": 4, "steps": 60, "weight_decay": 0.1}
    whole, rows = noisy(tmp_path / "whole", **settings)
    for number, how in ((1, Killed), (1, Interrupted), (3, Killed), (6, Interrupted)):
        with stopped(how, number * 10):
            noisy(tmp_path / "run", **settings)
        torch.manual_seed(99)
    agent, found = noisy(tmp_path / "run", **settings)
    assert same(agent, whole)
    assert found == rows


@pytest.mark.parametrize("stop", ["held_out", "fixed"])
def test_a_finished_cloning_is_only_loaded(stop, tmp_path):
    agent, rows = noisy(tmp_path, stop=stop, steps=100)
    before = (tmp_path / "bc.safetensors").stat().st_mtime_ns
    again, same_rows = noisy(tmp_path, stop=stop, steps=100)
    assert same(agent, again)
    assert rows == same_rows
    assert (tmp_path / "bc.safetensors").stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("spec", "actions"),
    [
        (DISCRETE, torch.ones(40, 1, dtype=torch.int64)),
        (DISCRETE, torch.ones(40)),
        (DISCRETE, torch.full((40,), 3)),
        (DISCRETE, torch.ones(40, 3, dtype=torch.int64)),
        (BOX, torch.zeros(40)),
        (BOX, torch.zeros(40, 1)),
    ],
    ids=["column", "floats", "outside", "not one-hot", "no width", "another width"],
)
def test_actions_that_the_policy_cannot_play_are_refused(spec, actions, tmp_path):
    data = pairs(40, spec=spec).set("action", actions)
    with pytest.raises(UserError, match=r"actions are torch.* and the policy's are"):
        cloned(tmp_path, data, spec=spec, stop="fixed")


@pytest.mark.parametrize("missing", ["observation", "action"])
def test_pairs_that_lack_an_entry_are_refused(missing, tmp_path):
    with pytest.raises(UserError, match=f"the batch has no '{missing}'"):
        cloned(tmp_path, pairs(40).exclude(missing), stop="fixed")
