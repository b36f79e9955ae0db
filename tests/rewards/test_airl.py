import pytest
import torch
import torch.nn.functional as F
from reward_data import Fixed
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical

from giril_rl.config.schema import RewardRunConfig
from giril_rl.errors import UserError
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.airl import (
    AIRLConfig,
    AIRLLoss,
    AIRLReward,
    airl_logit,
    with_log_prob,
)
from giril_rl.rewards.scaler import ObservationScaler

BOX = Bounded(-1.0, 1.0, shape=(1,))


def by_hand(form, **kwargs):
    """``g = s1 + 10 a`` and ``h = 2 s2``."""
    return AIRLReward(
        Fixed(lambda x: x[..., :1] + 10 * x[..., 2:]),
        Fixed(lambda x: 2 * x[..., 1:]),
        scaler=ObservationScaler(2, rule="raw", clamp=False),
        actions=ActionEncoder(BOX),
        form=form,
        gamma=0.5,
        **kwargs,
    )


def batch():
    """Two transitions alike, but that the second is a failure."""
    return TensorDict(
        {
            "observation": torch.tensor([[3.0, 4.0]] * 2),
            "action": torch.tensor([[0.5]] * 2),
            "policy_log_prob": torch.tensor([-1.0, -2.0]),
            "next": {
                "observation": torch.tensor([[7.0, 6.0]] * 2),
                "terminated": torch.tensor([[False], [True]]),
            },
        },
        [2],
    )


@pytest.mark.parametrize(
    ("form", "expected"),
    # g = 3 + 5; f = 8 + 0.5 * 12 - 8, or 8 - 8 where nothing follows.
    [("g", [8.0, 8.0]), ("f", [6.0, 0.0]), ("log_ratio", [7.0, 2.0])],
)
def test_the_three_forms_by_hand(form, expected):
    reward = by_hand(form)(batch())["next", "intrinsic_reward"]
    assert reward.flatten().tolist() == expected


def test_the_logit_is_that_of_the_papers_discriminator():
    f, log_pi = torch.randn(2, 1000, dtype=torch.float64)
    d = f.exp() / (f.exp() + log_pi.exp())
    logit = airl_logit(f, log_pi)
    torch.testing.assert_close(logit.sigmoid(), d)
    torch.testing.assert_close(logit, d.log() - (1 - d).log())


def test_potentials_cancel_along_an_episode():
    """The discounted sum of f is that of g, less the first state's potential."""
    reward = AIRLReward.for_vectors(2, BOX, hidden=[8], gamma=0.9, normalise="raw").eval()
    s, a = torch.randn(6, 2), torch.rand(5, 1)
    ends = torch.zeros(5, 1, dtype=torch.bool)
    ends[-1] = True
    episode = TensorDict(
        {"observation": s[:5], "action": a, "next": {"observation": s[1:], "terminated": ends}}, [5]
    )
    discount = 0.9 ** torch.arange(5.0)
    with torch.no_grad():
        f = reward(episode)["next", "intrinsic_reward"].squeeze(-1)
        g = reward.unshaped(s[:5], a)
        torch.testing.assert_close((discount * f).sum(), (discount * g).sum() - reward.h(s[0])[0])


def sets(reward, sizes=(5, 9)):
    out = {}
    for side, n in zip(("expert", "policy"), sizes, strict=True):
        out[side] = {
            "observation": torch.randn(n, 3),
            "action": torch.rand(n, 1),
            "policy_log_prob": torch.randn(n),
            "next": {"observation": torch.randn(n, 3), "terminated": torch.rand(n, 1) < 0.3},
        }
    return TensorDict(out)


def test_the_loss_is_binary_cross_entropy_of_f_minus_log_pi():
    reward = AIRLReward.for_vectors(3, BOX, hidden=[8], normalise="raw", form="log_ratio")
    batch = sets(reward)
    found = AIRLLoss(reward)(batch)
    for side, label in (("expert", 1.0), ("policy", 0.0)):
        data = batch[side]
        logit = reward(TensorDict(data.to_dict(), [len(data["action"])]))[
            "next", "intrinsic_reward"
        ]
        expected = F.binary_cross_entropy_with_logits(logit, torch.full_like(logit, label))
        torch.testing.assert_close(found[f"loss_{side}"], expected)


def test_the_penalty_is_on_the_slope_of_f():
    """f of slope (1, 0), 10 and (0, 1) in s, a and s', whatever the points."""
    loss = AIRLLoss(by_hand("f"), penalty=2.0)
    data = batch()
    both = TensorDict({"expert": data.to_dict(), "policy": data.to_dict()})
    slope = torch.tensor([1.0, -2.0, 10.0, 0.0, 1.0]).norm()
    torch.testing.assert_close(loss(both)["loss_penalty"], 2 * (slope - 1).square())


def test_the_policys_log_probability_is_read_only_where_it_counts():
    plain, ratio = by_hand("f"), by_hand("log_ratio")
    calls = []

    def log_prob(observation, action):
        calls.append(len(observation))
        return torch.tensor([-3.0, -4.0])

    assert with_log_prob(plain, log_prob) is plain
    bare = batch().exclude("policy_log_prob")
    with pytest.raises(UserError, match="policy_log_prob"):
        ratio(bare.clone())
    reward = with_log_prob(ratio, log_prob)(bare)["next", "intrinsic_reward"]
    assert reward.flatten().tolist() == [9.0, 4.0] and calls == [2]


def test_a_reward_of_states_ignores_the_action():
    reward = AIRLReward.for_vectors(3, Categorical(4), hidden=[8], state_only=True)
    assert reward.g[0].in_features == reward.h[0].in_features == 3
    assert AIRLReward.for_vectors(3, Categorical(4), hidden=[8]).g[0].in_features == 7


def test_learner_decides_what_is_left_open():
    ppo = AIRLConfig().settled(RewardRunConfig())
    assert (ppo.form, ppo.gamma) == ("log_ratio", 0.99)
    run = RewardRunConfig(algorithm="sac")
    run.sac.gamma = 0.9
    sac = AIRLConfig().settled(run)
    assert (sac.form, sac.gamma) == ("f", 0.9)
    given = AIRLConfig(form="g", gamma=0.5).settled(run)
    assert (given.form, given.gamma) == ("g", 0.5)


def test_refusals():
    with pytest.raises(UserError, match="form='h' is unknown"):
        by_hand("h")
    with pytest.raises(UserError, match="four in_keys"):
        by_hand("f", in_keys=["observation", "action"])
    wrong = batch().set(("next", "terminated"), torch.tensor([False, True]))
    with pytest.raises(UserError, match=r"terminated has shape \(2,\): give \(2, 1\)"):
        by_hand("f")(wrong)
    wrong = batch().set("policy_log_prob", torch.zeros(2, 1))
    with pytest.raises(UserError, match="log-probability has shape"):
        by_hand("log_ratio")(wrong)
    with pytest.raises(UserError, match="penalty=-1"):
        AIRLLoss(by_hand("f"), penalty=-1)
