"""Log-probabilities of an environment's actions, against torch's own distributions."""

import pytest
import torch
from torch.distributions import Normal
from torchrl.data import Bounded, Categorical, OneHot, Unbounded

from giril_rl.policies import ActorCritic, PixelActorCritic


def agent_of(spec, **kwargs):
    agent = ActorCritic(3, spec, hidden=[8], normalise=False, **kwargs)
    torch.nn.init.normal_(agent.actor[-1].weight, std=0.3)
    if agent.log_std is not None:
        torch.nn.init.normal_(agent.log_std, std=0.3)
    return agent


def test_inside_the_bounds_it_is_the_density_and_at_them_all_that_lies_beyond():
    agent = agent_of(Bounded(torch.tensor([-2.0, 0.0]), torch.tensor([2.0, 4.0]), shape=(2,)))
    s = torch.randn(5, 3)
    with torch.no_grad():
        draws = Normal(agent.actor(s).double(), agent.log_std.exp().double())
    inside = torch.tensor([1.0, 1.0])  # In units of the bounds: 0.5 and -0.5.
    expected = draws.log_prob(torch.tensor([0.5, -0.5])).sum(-1).float()
    torch.testing.assert_close(agent.log_prob(s, inside.expand(5, 2)), expected)
    low, high = (torch.tensor(bound, dtype=torch.float64) for bound in (-1.0, 1.0))
    below, above = draws.cdf(low).log(), (1 - draws.cdf(high)).log()
    corner = torch.tensor([-2.0, 4.0]).expand(5, 2)
    expected = (below[:, 0] + above[:, 1]).float()
    torch.testing.assert_close(agent.log_prob(s, corner), expected, atol=1e-4, rtol=1e-4)
    beyond = torch.tensor([-9.0, 9.0]).expand(5, 2)
    torch.testing.assert_close(agent.log_prob(s, beyond), agent.log_prob(s, corner))


def test_it_adds_up_to_one():
    agent = agent_of(Bounded(-2.0, 2.0, shape=(1,)))
    s = torch.randn(1, 3)
    grid = torch.linspace(-2.0, 2.0, 4001)[1:-1].unsqueeze(-1)
    density = agent.log_prob(s.expand(len(grid), 3), grid).exp()
    inside = torch.trapezoid(density, grid.squeeze(-1) / 2)  # In units of the bounds.
    ends = agent.log_prob(s.expand(2, 3), torch.tensor([[-2.0], [2.0]])).exp().sum()
    assert (inside + ends).item() == pytest.approx(1.0, abs=1e-2)


def test_of_what_it_draws_itself():
    for spec in (Categorical(4), OneHot(4), Unbounded((2,))):
        agent = agent_of(spec)
        s = torch.randn(6, 3)
        action, log_prob, *_ = agent.act(s)
        torch.testing.assert_close(agent.log_prob(s, action), log_prob.detach())
        assert not agent.log_prob(s, action).requires_grad


def test_of_frames():
    agent = PixelActorCritic(4)
    frames = torch.randint(256, (3, 4, 84, 84), dtype=torch.uint8)
    action, log_prob, _ = agent.act(frames)
    torch.testing.assert_close(agent.log_prob(frames, action), log_prob.detach())


def test_leading_shapes_are_kept():
    agent = agent_of(Bounded(-1.0, 1.0, shape=(2,)))
    assert agent.log_prob(torch.randn(4, 5, 3), torch.zeros(4, 5, 2)).shape == (4, 5)
