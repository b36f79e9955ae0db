import json
import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot, Unbounded

from giril_rl.errors import UserError
from giril_rl.policies import ActorCritic, PixelActorCritic, load_agent_from
from giril_rl.rewards import (
    BottleneckReward,
    CuriosityReward,
    DiscriminatorReward,
    GenerativeReward,
    ObservationScaler,
)
from giril_rl.rewards.actions import ActionEncoder

BOX = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0]), shape=(2,))
NESTED = {
    "in_keys": ["seen", ("agent", "action"), ("next", "seen")],
    "out_keys": [("next", "agent", "paid")],
}


def vectors(spec, size):
    action = torch.randint(3, (5,)) if isinstance(spec, Categorical) else torch.rand(5, size)
    return TensorDict(
        {
            "observation": torch.randn(5, 3),
            "action": action,
            "next": {"observation": torch.rand(5, 3)},
        },
        [5],
    )


@pytest.mark.parametrize(
    "cls", [GenerativeReward, CuriosityReward, DiscriminatorReward, BottleneckReward]
)
@pytest.mark.parametrize(
    "spec", [BOX, Categorical(3), Unbounded(shape=(2,))], ids=["box", "discrete", "unbounded"]
)
def test_a_reward_comes_back_with_all_that_decides_its_numbers(cls, spec, tmp_path):
    reward = cls.for_vectors(3, spec, hidden=[8], seed=5)
    reward.scaler.fit(torch.randn(50, 3))
    folder = reward.save_pretrained(tmp_path / "mine", {"method": "giril", "return_mean": 990.0})
    state = torch.get_rng_state()
    again = cls.from_pretrained(folder)
    assert not again.training
    assert torch.equal(torch.get_rng_state(), state)
    batch = vectors(spec, 2)
    key = ("next", "intrinsic_reward")
    assert torch.equal(again(batch.clone())[key], reward.eval()(batch.clone())[key])
    card = json.loads((folder / "card.json").read_text())
    assert (card["method"], card["return_mean"], card["format_version"]) == ("giril", 990.0, 1)
    assert "torch" in card["versions"]
    assert sorted(path.name for path in folder.iterdir()) == ["card.json", "model.safetensors"]


def test_pixels_keys_and_noise_come_back(tmp_path):
    reward = GenerativeReward.for_pixels(Categorical(4), beta=0.5, prior="conditional", **NESTED)
    again = GenerativeReward.from_pretrained(reward.save_pretrained(tmp_path))
    frames = torch.randint(0, 256, (3, 4, 84, 84), dtype=torch.uint8)
    batch = TensorDict(
        {"seen": frames, "agent": {"action": torch.tensor([0, 3, 1])}, "next": {"seen": frames}},
        [3],
    )
    expected = reward.eval()(batch.clone())["next", "agent", "paid"]
    assert torch.equal(again(batch)["next", "agent", "paid"], expected)


@pytest.mark.parametrize(
    "agent",
    [
        ActorCritic(3, BOX),
        ActorCritic(3, Categorical(4, shape=(1,)), hidden=[8], normalise=False),
        ActorCritic(3, OneHot(4)),
        PixelActorCritic(6),
        PixelActorCritic(OneHot(6)),
    ],
)
def test_a_policy_comes_back_whichever_it_is(agent, tmp_path):
    again = load_agent_from(agent.save_pretrained(tmp_path))
    assert type(again) is type(agent)
    assert (again.made_with, again.one_hot) == (agent.made_with, agent.one_hot)
    for name, value in agent.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name


def test_a_policy_from_before_actions_were_scaled_is_read_where_it_acts_the_same(tmp_path):
    plain = ActorCritic(3, Bounded(-1.0, 1.0, shape=(2,)))
    half_bounded = ActorCritic(3, Bounded(torch.tensor([0.0]), torch.tensor([math.inf])))
    for number, agent in enumerate((plain, half_bounded, ActorCritic(3, Unbounded((1,))))):
        folder = agent.save_pretrained(tmp_path / str(number))
        assert json.loads((folder / "card.json").read_text())["format_version"] == 1
        again = load_agent_from(folder)
        assert again.acting_keys == agent.acting_keys
        if agent.bounds is not None:
            assert torch.equal(again.bounds.high, agent.bounds.high)
    folder = ActorCritic(3, BOX).save_pretrained(tmp_path / "scaled")
    assert load_agent_from(folder).bounds.offset.tolist() == [0.0, 2.0]
    with pytest.raises(
        UserError, match=r"has format 1, of a policy or reward that .*train it anew"
    ):
        load_agent_from(changed(folder, format_version=1))


def saved(tmp_path):
    reward = GenerativeReward.for_vectors(3, BOX, hidden=[8], normalise="raw")
    return reward.save_pretrained(tmp_path / "saved")


def changed(folder, **changes):
    path = folder / "card.json"
    card = json.loads(path.read_text())
    for key, value in changes.items():
        (card["made_by"] if key in card["made_by"] else card)[key] = value
    path.write_text(json.dumps(card))
    return folder


def test_weights_of_another_module_are_refused(tmp_path):
    folder = saved(tmp_path)
    card = json.loads((folder / "card.json").read_text())
    changed(folder, arguments={**card["made_by"]["arguments"], "hidden": [16]})
    with pytest.raises(UserError, match="does not fit its card"):
        GenerativeReward.from_pretrained(folder)
    with pytest.raises(UserError, match="holds no saved module"):
        GenerativeReward.from_pretrained(tmp_path)


def test_networks_of_ones_own_have_no_card(tmp_path):
    reward = GenerativeReward(
        nn.Identity(),
        nn.Identity(),
        scaler=ObservationScaler(2, rule="raw"),
        actions=ActionEncoder(BOX),
    )
    with pytest.raises(UserError, match="was made of networks of your own"):
        reward.save_pretrained(tmp_path / "x")
    assert not (tmp_path / "x").exists()
