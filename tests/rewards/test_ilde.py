import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded

from giril_rl.errors import UserError
from giril_rl.rewards import AffineReward, ConstantReward, DiscriminatorReward, ObservationScaler
from giril_rl.rewards.entropy_bonus import EntropyBonus, knn_bonus
from giril_rl.rewards.ilde import ILDEConfig, InMinibatches, SummedReward, Term
from giril_rl.rewards.sqil import SQILConfig, sqil_reward
from giril_rl.transforms import IntrinsicReward


def transitions(*shape):
    entries = {"observation": torch.randn(*shape, 3), "action": torch.rand(*shape, 1)}
    entries["next"] = {"observation": torch.randn(*shape, 3), "reward": torch.zeros(*shape, 1)}
    return TensorDict(entries, shape)


def test_the_sum_is_that_of_its_terms():
    imitation = DiscriminatorReward.for_vectors(3, Bounded(-1, 1, shape=(1,)), normalise="raw")
    bonus = EntropyBonus(ObservationScaler(3, rule="raw", clamp=False), k=2)
    double = AffineReward(ConstantReward(3.0), scale=2.0)
    terms = {"imitation": Term(0.5, imitation), "c": Term(0.1, double), "bonus": Term(4.0, bonus)}
    batch = transitions(2, 5)
    found = IntrinsicReward(SummedReward(terms))(batch)["next", "reward"]
    with torch.no_grad():
        expected = 0.5 * imitation(batch.clone())["next", "intrinsic_reward"] + 0.6
    states = batch["next", "observation"].reshape(-1, 3)
    expected += 4.0 * knn_bonus(states, k=2).reshape(2, 5, 1)
    torch.testing.assert_close(found, expected)
    assert set(batch.keys(True)) == set(transitions(2, 5).keys(True))


def test_each_minibatch_is_a_batch_of_its_own():
    bonus = EntropyBonus(ObservationScaler(3, rule="raw", clamp=False), k=2)
    module, flat = InMinibatches(bonus, size=4), transitions(10)
    found = module(flat)["next", "intrinsic_reward"].squeeze(-1)
    parts = flat["next", "observation"].split(4)
    torch.testing.assert_close(found, torch.cat([knn_bonus(part, k=2) for part in parts]))
    collected = flat.reshape(2, 5)
    whole = module(collected)["next", "intrinsic_reward"].flatten()
    torch.testing.assert_close(whole, knn_bonus(flat["next", "observation"], k=2))


def test_a_sum_of_nothing_is_refused():
    off = ILDEConfig(imitation="none", curiosity_weight=0.0, bonus_weight=0.0)
    with pytest.raises(UserError, match=r"reward\.imitation_weight, .* are off"):
        off.check("reward.", None)
    ILDEConfig(imitation="none", curiosity_weight=0.0).check("reward.", None)
    with pytest.raises(UserError, match="no terms"):
        SummedReward({})
    two = TensorDictModule(lambda x: (x, x), ["observation"], ["a", "b"])
    with pytest.raises(UserError, match="'c' writes"):
        SummedReward({"c": Term(1.0, two)})


def test_what_imitates():
    assert ILDEConfig().imitates and ILDEConfig(imitation="vail").imitates
    assert not ILDEConfig(imitation="none").imitates
    assert not ILDEConfig(imitation_weight=0.0).imitates
    assert ILDEConfig(imitation="pwil").along_time and not ILDEConfig().along_time
    assert not ILDEConfig(imitation="pwil", imitation_weight=0.0).along_time


def test_sqil_pays_nothing_for_what_the_agent_does():
    reward = sqil_reward(SQILConfig(), None, None)
    assert reward(transitions(2, 3))["next", "intrinsic_reward"].tolist() == [[[0.0]] * 3] * 2
    paid = sqil_reward(SQILConfig(own=-1.0), None, None)(transitions(1))
    assert paid["next", "intrinsic_reward"].item() == -1.0
