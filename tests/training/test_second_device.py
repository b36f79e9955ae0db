"""``device=cuda`` where there is no GPU: nothing that trains mixes devices or waits for a value."""

import pytest
import torch
from second_device import DEVICE, second_device
from tensordict import TensorDict
from torch import nn
from torch._subclasses.fake_tensor import DataDependentOutputException
from torchrl.data import Bounded, Categorical
from torchrl.envs import Compose
from torchrl.objectives.value import GAE

from giril_rl.config.schema import PPOConfig
from giril_rl.graphs import recording
from giril_rl.graphs.gradients import TracedGradients
from giril_rl.graphs.recording import record
from giril_rl.policies.actor_critic import ActorCritic
from giril_rl.policies.pixel_actor_critic import PixelActorCritic
from giril_rl.rewards import (
    AdversarialConfig,
    AffineReward,
    BottleneckLoss,
    BottleneckReward,
    ConstantReward,
    CopyReward,
    CuriosityReward,
    CuriosityRewardLoss,
    DiscriminatorLoss,
    DiscriminatorReward,
    GenerativeReward,
    GenerativeRewardLoss,
    ObservationScaler,
    PixelScaler,
    fitting,
)
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.fitting import fit
from giril_rl.training import AdversarialTrainer
from giril_rl.training.ppo import PPO
from giril_rl.transforms import BatchMeanReward, IntrinsicReward, ReturnScaling

ENVS, TIME = 2, 8
ACTIONS = {"vectors": Bounded(-1, 1, shape=(1,)), "pixels": Categorical(4)}
SIZES = {"vectors": (3,), "pixels": (4, 84, 84)}


@pytest.fixture(params=ACTIONS)
def kind(request):
    return request.param


def observations(kind, *batch):
    shape = (*batch, *SIZES[kind])
    return torch.randint(256, shape, dtype=torch.uint8) if kind == "pixels" else torch.randn(shape)


def transitions(kind, *batch):
    """Random ones on the CPU."""
    action = torch.randint(4, batch) if kind == "pixels" else torch.rand(*batch, 1)
    following = {"observation": observations(kind, *batch)}
    entries = {"observation": observations(kind, *batch), "action": action, "next": following}
    return TensorDict(entries, batch)


def made(cls, kind, **kwargs):
    """A reward, with its scalers fitted."""
    spec = ACTIONS[kind]
    reward = (
        cls.for_pixels(spec, **kwargs) if kind == "pixels" else cls.for_vectors(3, spec, **kwargs)
    )
    for part in reward.modules():
        if isinstance(part, ObservationScaler):
            part.fit(torch.randn(20, 3))
    return reward


def agent_for(kind):
    return PixelActorCritic(4) if kind == "pixels" else ActorCritic(3, ACTIONS[kind], hidden=(8,))


class Eager(TracedGradients):
    """Not recorded, for tensors without values cannot be."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self._graph._recorded = False


def test_devices_do_not_mix():
    linear = nn.Linear(2, 2)
    with second_device() as device:
        device.take(linear)
        assert linear(torch.ones(3, 2).to(DEVICE)).device == DEVICE
        with pytest.raises((RuntimeError, ValueError), match="device"):
            linear(torch.ones(3, 2))


def test_values_are_not_looked_at():
    with second_device(), pytest.raises(DataDependentOutputException):
        torch.ones(2).to(DEVICE).sum().item()


@pytest.mark.parametrize(
    ("cls", "loss", "settings"),
    [
        (GenerativeReward, GenerativeRewardLoss, {"prior": "standard"}),
        (GenerativeReward, GenerativeRewardLoss, {"prior": "conditional"}),
        (CuriosityReward, CuriosityRewardLoss, {}),
    ],
)
def test_fitting_a_reward(cls, loss, settings, kind):
    module = loss(made(cls, kind, **settings))
    data = transitions(kind, 8)
    with second_device() as device:
        device.take(module)
        gradients = Eager(module, keys=module.in_keys)
        losses = gradients(device.batch(data))
        torch.optim.Adam(gradients.parameters).step()
    assert losses and {x.device for x in losses.values()} == {DEVICE}
    assert {p.grad.device for p in gradients.parameters} == {DEVICE}


@pytest.mark.parametrize("penalty", [0.0, 10.0])
@pytest.mark.parametrize(
    ("cls", "loss"), [(DiscriminatorReward, DiscriminatorLoss), (BottleneckReward, BottleneckLoss)]
)
def test_training_a_discriminator(cls, loss, penalty, kind):
    module = loss(made(cls, kind), penalty=penalty)
    keys = ["observation", "action"]
    expert, policy = transitions(kind, 20).select(*keys), transitions(kind, 4, 8).select(*keys)
    learner = AdversarialTrainer(module, expert, AdversarialConfig(batch=8, updates=2), seed=0)
    with second_device(values=True) as device:
        device.take(module)
        learner.gradients = Eager(module, keys=module.in_keys, log=module.log_keys)
        learner.optimizer = torch.optim.Adam(learner.gradients.parameters)
        learner._device = DEVICE
        learner._expert = [device.tensor(x) for x in learner._expert]
        metrics = learner.update(device.batch(policy))
    assert "discriminator/loss_expert" in metrics


def test_a_step_of_ppo(kind):
    agent = agent_for(kind)
    learner = PPO(agent, PPOConfig(clip_value=True, entropy_coef=0.01), steps=8)
    rows = {agent.drawn_key: transitions(kind, 8)["action"], agent.input_keys[0]: torch.randn(8, 3)}
    if kind == "pixels":
        rows[agent.input_keys[0]] = agent.actor.deal(observations(kind, 8))
    scalars = ("advantage", "value_target", "state_value")
    rows |= {"action_log_prob": torch.randn(8), **{k: torch.randn(8, 1) for k in scalars}}
    with second_device() as device:
        loss = device.take(learner.gradients.module.loss)
        gradients = Eager(loss, keys=learner.keys, log=("kl_approx",), max_grad_norm=0.5)
        logs = gradients.step([device.tensor(rows[key]) for key in learner.keys])
        torch.optim.Adam(gradients.parameters).step()
    assert {x.device for x in logs.values()} == {DEVICE}


@pytest.mark.parametrize("termination", ["ends", "bootstrap"])
def test_acting_relabelling_and_learning(kind, termination, monkeypatch):
    """A batch as :func:`giril_rl.training.train_ppo` goes through it."""
    # TorchRL asks once a batch whether an observation is NaN, and would copy it.
    monkeypatch.setattr(GAE, "_sanitize_next_obs_nan", staticmethod(lambda data, in_keys: data))
    # As do the running normalisation and the scaling of returns.
    monkeypatch.setattr("giril_rl.networks.normalise._check_finite", lambda observation: None)
    monkeypatch.setattr("giril_rl.transforms.scaling._finite", lambda value: True)
    agent = agent_for(kind)
    reward = made(GenerativeReward, kind).eval()
    relabel = Compose(IntrinsicReward(reward), BatchMeanReward(), ReturnScaling())
    cfg = PPOConfig(num_envs=ENVS, rollout=TIME, minibatch=8, epochs=2, clip_value=True)
    learner = PPO(agent, cfg, steps=ENVS * TIME, termination=termination)
    batch = TensorDict({"observation": observations(kind, ENVS, TIME)}, [ENVS, TIME])
    ended = torch.zeros(ENVS, TIME, 1, dtype=torch.bool)
    following = observations(kind, ENVS, TIME)
    batch["next"] = {"observation": following, "reward": torch.ones(ENVS, TIME, 1)}
    for name in ("done", "terminated", "truncated"):
        batch["next", name] = ended.clone()
    with second_device(values=True) as device:
        loss = learner.gradients.module.loss
        for module in (agent, relabel, learner.advantage, loss):
            device.take(module)
        learner.gradients = Eager(
            loss, keys=learner.keys, log=("kl_approx",), max_grad_norm=cfg.max_grad_norm
        )
        learner.optimizer = torch.optim.Adam(learner.gradients.parameters)
        acted = agent.acting()(batch.apply(device.mode.from_tensor))
        assert {x.device.type for x in acted.values(True, True)} == {"cpu"}
        collected = acted.to(DEVICE)
        relabel(collected)
        moved = relabel(collected)  # What was kept from the first batch is not looked at.
        assert moved["next", "reward"].device == DEVICE
        assert "loss_critic" in learner.update(moved)


@pytest.mark.parametrize("reward", ["weights", "buffers", "neither"])
@pytest.mark.parametrize("true", [True, False])
def test_a_reward_elsewhere_than_its_batch(kind, reward, true):
    """An environment on the CPU may have a reward on a GPU."""
    scaler = ObservationScaler(3).fit(torch.randn(20, 3)) if kind == "vectors" else PixelScaler()
    rewards = {
        "weights": lambda: made(GenerativeReward, kind).eval(),
        "buffers": lambda: AffineReward(CopyReward(scaler), shift=1.0),
        "neither": ConstantReward,
    }
    module = rewards[reward]()
    relabel = IntrinsicReward(module, extrinsic_key="extrinsic_reward" if true else None)
    batch = transitions(kind, ENVS, TIME)
    if true:
        batch["next", "reward"] = torch.ones(ENVS, TIME, 1)
    with second_device(values=True) as device:
        device.take(relabel)
        relabelled = relabel(batch.apply(device.mode.from_tensor))
    assert {x.device.type for x in relabelled.values(True, True)} == {"cpu"}
    assert relabelled["next", "reward"].shape == (ENVS, TIME, 1)


def test_all_of_vails_loss_goes_where_its_reward_is(kind):
    reward = made(BottleneckReward, kind).to(DEVICE)
    loss = BottleneckLoss(reward)
    expert = transitions(kind, 20).select("observation", "action")
    AdversarialTrainer(loss, expert, AdversarialConfig(), seed=0)
    assert loss.beta.device == DEVICE


def test_a_demonstration_is_taken_to_the_loss_it_is_fitted_by(monkeypatch):
    loss = GenerativeRewardLoss(made(GenerativeReward, "vectors"))
    monkeypatch.setattr(ObservationScaler, "fit", lambda *_: None)  # It looks at values.
    monkeypatch.setattr(fitting, "check_finite", lambda *_: None)  # So do these, once.
    monkeypatch.setattr(ActionEncoder, "check_values", lambda *_: None)
    monkeypatch.setattr(fitting.math, "isfinite", lambda _: True)
    monkeypatch.setattr(torch.optim, "Adam", lambda parameters, lr: torch.optim.SGD(parameters))
    data = transitions("vectors", 8)
    with second_device(values=True) as device:
        device.take(loss)
        terms = fit(loss, data.apply(device.mode.from_tensor), steps=2, batch=4)
    assert "loss_reconstruction" in terms


def test_a_graph_for_another_device_is_not_compiled(monkeypatch):
    # There are no values there to compare the graph's with.
    monkeypatch.setattr(torch, "equal", lambda *_: True)
    monkeypatch.setattr(recording, "_equal", lambda *_: True)
    on_cpu, elsewhere = (
        record(lambda x: (x + x,), [torch.ones(2, device=device)]) for device in ("cpu", DEVICE)
    )
    assert isinstance(on_cpu, torch.jit.ScriptFunction | torch.jit.ScriptModule)
    assert isinstance(elsewhere, torch.fx.GraphModule)
    assert elsewhere(torch.ones(2))[0].tolist() == [2.0, 2.0]
