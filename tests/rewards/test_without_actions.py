"""``use_actions=False``: rewards of states alone, of networks that are trained."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from reward_cases import FRAMES, Case, transitions
from reward_data import total
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Unbounded

from giril_rl.config.validation import validate
from giril_rl.errors import UserError
from giril_rl.graphs.gradients import TracedGradients
from giril_rl.methods import methods
from giril_rl.rewards import (
    CuriosityConfig,
    CuriosityReward,
    CuriosityRewardLoss,
    GenerativeConfig,
    GenerativeReward,
    GenerativeRewardLoss,
    fit,
)

STATES_ALONE = ["giril", "cdil", "gail", "vail", "red"]
NETWORKS = {"normalise": "pixels"}


def made(name, pixels=False):
    """A reward of states, its loss, and transitions without actions."""
    method = methods()[name]
    changes = {"use_actions": False, **(NETWORKS if pixels else {"hidden": [16, 16]})}
    if name == "cdil":
        changes["features"] = "none"
    settings = replace(method.settings(), **changes)
    validate(settings)
    spec = Unbounded(FRAMES, dtype=torch.uint8) if pixels else Unbounded((3,))
    env = SimpleNamespace(action_spec=Categorical(3), observation_spec={"observation": spec})
    states = transitions(Case("", None, "pixels" if pixels else "box"), 8).exclude("action")
    reward = method.build(settings, env, states, seed=0)
    return reward, method.loss(reward, settings), states


@pytest.mark.parametrize("pixels", [False, True], ids=["vectors", "pixels"])
@pytest.mark.parametrize("name", STATES_ALONE)
def test_it_learns_from_states_and_pays_for_states(name, pixels):
    reward, loss, states = made(name, pixels)
    assert "action" not in reward.in_keys
    batch = states
    if methods()[name].trained == "beside":
        batch = TensorDict({"expert": states[:3], "policy": states[3:]})
    gradients = TracedGradients(loss, keys=loss.in_keys)
    out = gradients(batch)
    assert total(TensorDict(out)).isfinite()
    assert any(parameter.grad.any() for parameter in gradients.parameters)
    paid = reward.eval()(states.clone())["next", "intrinsic_reward"]
    assert paid.shape == (8, 1) and paid.unique().numel() > 1


@pytest.mark.parametrize("name", STATES_ALONE)
def test_a_saved_reward_of_states_stays_one(name, tmp_path):
    reward, _, states = made(name)
    loaded = type(reward).from_pretrained(reward.save_pretrained(tmp_path / "reward"))
    assert loaded.in_keys == reward.in_keys and not loaded.actions.use_actions
    noisy = isinstance(reward, GenerativeReward)
    assert noisy or torch.equal(
        *(r.eval()(states.clone())["next", "intrinsic_reward"] for r in (reward, loaded))
    )


def test_a_reward_that_was_saved_before_the_setting_existed_reads_actions(tmp_path):
    reward = GenerativeReward.for_vectors(3, Bounded(-1, 1, shape=(1,)), hidden=[8])
    folder = reward.save_pretrained(tmp_path / "reward")
    card = json.loads((folder / "card.json").read_text())
    del card["made_by"]["arguments"]["use_actions"]
    (folder / "card.json").write_text(json.dumps(card))
    loaded = GenerativeReward.from_pretrained(folder)
    assert loaded.actions.use_actions and "action" in loaded.in_keys


def test_girils_latent_is_as_large_as_the_action_and_nothing_supervises_it():
    spec = Bounded(-1, 1, shape=(5,))
    reward = GenerativeReward.for_vectors(
        3, spec, hidden=[16], use_actions=False, prior="conditional", normalise="raw"
    )
    states = transitions(Case("", None), 6).exclude("action")
    s, s_next = states["observation"], states["next", "observation"]
    assert reward.encode(s, s_next)[0].shape == (6, 5)
    torch.manual_seed(0)
    terms = GenerativeRewardLoss(reward, reduction="none")(states)
    assert set(terms.keys()) == {"loss_reconstruction", "loss_kl"}
    # The limit beta -> 0 of eq. 2: z itself goes into the decoder.
    scaled, wanted = reward.scaler(s), reward.scaler(s_next)
    mu, logvar = reward.encode(scaled, wanted)
    noise = torch.randn(mu.shape, generator=torch.Generator().manual_seed(0))
    predicted = reward.decode(mu + (0.5 * logvar).exp() * noise, scaled).clamp(-1, 1)
    torch.testing.assert_close(
        reward(states)["next", "intrinsic_reward"].squeeze(-1),
        (predicted - wanted).square().sum(-1),
    )


def test_icms_random_features_are_predicted_from_the_state_alone():
    reward = CuriosityReward.for_vectors(
        3, Categorical(4), hidden=[], model_hidden=[8], use_actions=False, normalise="raw"
    )
    assert reward.inverse_model is None
    states = transitions(Case("", None), 6).exclude("action")
    loss = CuriosityRewardLoss(reward, features="none")
    assert list(loss(states).keys()) == ["loss_forward"]
    s, s_next = (reward.scaler(states[key]) for key in ("observation", ("next", "observation")))
    wanted = (reward.forward_model(s) - s_next).square().sum(-1, keepdim=True)
    torch.testing.assert_close(reward(states)["next", "intrinsic_reward"], wanted)


@pytest.mark.parametrize("features", ["inverse", "both"])
def test_features_are_not_trained_to_predict_actions_that_are_not_read(features):
    settings = CuriosityConfig(features=features, use_actions=False)
    with pytest.raises(UserError, match=r"^use_actions=false leaves the inverse model.*=none"):
        validate(settings)
    reward = CuriosityReward.for_vectors(3, Categorical(4), use_actions=False)
    with pytest.raises(UserError, match="features=none"):
        CuriosityRewardLoss(reward, features=features)


@pytest.mark.parametrize("weight", [{"beta": 0.5}, {"alpha": 2.0}])
def test_weights_of_an_action_that_is_not_read_are_refused(weight):
    validate(GenerativeConfig(**weight))
    (name,) = weight
    with pytest.raises(UserError, match=rf"^{name}=\d.* leave {name} out\.$"):
        validate(GenerativeConfig(use_actions=False, **weight))


def test_a_reward_of_actions_says_what_a_batch_lacks():
    reward = GenerativeReward.for_vectors(3, Bounded(-1, 1, shape=(1,)), normalise="raw")
    states = transitions(Case("", None), 6).exclude("action")
    with pytest.raises(UserError, match="the batch has no 'action'"):
        reward(states)


def test_it_is_fitted_in_one_call():
    reward, loss, states = made("red")
    losses = fit(loss, states, steps=3, batch=4)
    assert losses["loss_distillation"] > 0 and bool(reward.scaler.fitted)
