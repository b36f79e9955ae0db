"""Absorbing states of GAIL and VAIL, against sets in which they are rows like others."""

import pytest
import torch
import torch.nn.functional as F
from reward_data import frames
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical

from giril_rl.config.schema import RewardRunConfig
from giril_rl.errors import UserError
from giril_rl.rewards import (
    AdversarialConfig,
    BottleneckLoss,
    BottleneckReward,
    DiscriminatorLoss,
    DiscriminatorReward,
    adversarial_reward,
)
from giril_rl.rewards.generative import gaussian_kl

BOX = Bounded(-1.0, 1.0, shape=(2,))


def made(cls=DiscriminatorReward, **kwargs):
    return cls.for_vectors(3, BOX, hidden=[8], normalise="raw", absorbing=True, **kwargs)


def sets(rates=(0.25, 0.5)):
    """Eight pairs of the expert, four of the policy, with as many absorbing ones each."""
    out = {}
    for side, n, rate in zip(("expert", "policy"), (8, 4), rates, strict=True):
        ends = torch.arange(n).unsqueeze(-1) < rate * n
        observation, action = torch.randn(n, 3), torch.rand(n, 2)
        out[side] = {"observation": observation, "action": action, "next": {"terminated": ends}}
    return TensorDict(out)


def with_rows(reward, side):
    """A set's inputs with a row for each absorbing pair: zeros, and a last entry of 1."""
    encoding = F.pad(side["action"], (0, 1))
    ends = int(side["next", "terminated"].sum())
    absorbing = torch.tensor([[0.0, 0.0, 1.0]]).expand(ends, 3)
    observation = torch.cat((side["observation"], torch.zeros(ends, 3)))
    return observation, torch.cat((encoding, absorbing))


def test_each_failure_adds_an_absorbing_pair_to_its_set():
    reward, batch = made(), sets()
    found = DiscriminatorLoss(reward)(batch)
    for side, sign in (("expert", -1), ("policy", 1)):
        logit = reward.logit(*with_rows(reward, batch[side]))
        assert len(logit) == {"expert": 10, "policy": 6}[side]
        torch.testing.assert_close(found[f"loss_{side}"], F.softplus(sign * logit).mean())


def test_the_bottleneck_counts_them_too():
    reward, batch = made(BottleneckReward), sets()
    out = BottleneckLoss(reward, beta=1.0)(batch)
    kl = [gaussian_kl(*reward.encode(*with_rows(reward, batch[s]))).mean() for s in batch.keys()]
    torch.testing.assert_close(out["kl"], (kl[0] + kl[1]) / 2)


def test_without_failures_they_do_not_count():
    reward, batch = made(), sets(rates=(0.0, 0.0))
    found = DiscriminatorLoss(reward)(batch)
    for side, sign in (("expert", -1), ("policy", 1)):
        logit = reward.logit(*reward.inputs(batch[side, "observation"], batch[side, "action"]))
        torch.testing.assert_close(found[f"loss_{side}"], F.softplus(sign * logit).mean())


@pytest.mark.parametrize("form", ["positive", "negative", "log_ratio", "reversed"])
def test_its_reward_is_that_of_its_logit(form):
    reward = made(form=form)
    encoding = torch.tensor([[0.0, 0.0, 1.0]])
    with torch.no_grad():
        expected = adversarial_reward(reward.logit(torch.zeros(1, 3), encoding), form)[0]
    assert torch.equal(reward.absorbing_reward(), expected)


@pytest.mark.parametrize("cls", [DiscriminatorReward, BottleneckReward])
def test_training_tells_whose_failures_they_are(cls):
    kind = {DiscriminatorReward: DiscriminatorLoss, BottleneckReward: BottleneckLoss}[cls]

    def trained(rates):
        torch.manual_seed(0)
        reward = made(cls, form="log_ratio", seed=3)
        loss = kind(reward, penalty=1.0)
        optimiser = torch.optim.Adam(loss.parameters(), lr=1e-2)
        for _ in range(60):
            optimiser.zero_grad()
            out = loss(sets(rates))
            sum(value for name, value in out.items() if name.startswith("loss_")).backward()
            optimiser.step()
        return reward.absorbing_reward()

    assert trained((0.0, 0.5)) < -0.2 < 0.2 < trained((0.5, 0.0))


def test_frames_have_one_too():
    reward = DiscriminatorReward.for_pixels(Categorical(4), absorbing=True)
    data = frames(6)
    ends = torch.tensor([[False]] * 5 + [[True]])
    data["next", "terminated"] = ends
    both = TensorDict({"expert": data[:3].to_dict(), "policy": data[3:].to_dict()})
    out = DiscriminatorLoss(reward, penalty=1.0)(both)
    assert all(value.isfinite() for value in out.values())
    assert reward.absorbing_reward().isfinite()
    assert reward(data)["next", "intrinsic_reward"].shape == (6, 1)


def test_who_has_them():
    run = RewardRunConfig()
    assert AdversarialConfig().settled(run).absorbing is False
    run.algorithm = "sac"
    assert AdversarialConfig().settled(run).absorbing is True
    assert AdversarialConfig(absorbing=False).settled(run).absorbing is False
    run.termination = "bootstrap"
    assert AdversarialConfig().settled(run).absorbing is False
    with pytest.raises(UserError, match=r"reward\.absorbing=true .* termination=bootstrap"):
        AdversarialConfig(absorbing=True).check("reward.", run)


def test_a_reward_without_them_says_so():
    reward = DiscriminatorReward.for_vectors(3, BOX, hidden=[8])
    with pytest.raises(UserError, match="absorbing=true of a recipe"):
        reward.absorbing_reward()
