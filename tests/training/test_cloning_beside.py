import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot

from giril_rl.policies import ActorCritic, PixelActorCritic
from giril_rl.policies.soft_actor_critic import SACAgent
from giril_rl.runs.checkpoint import load_state, save_state
from giril_rl.training import CloningTrainer

SPECS = {
    "box": Bounded(-2.0, 2.0, shape=(2,)),
    "discrete": Categorical(3),
    "one_hot": OneHot(3),
}
AGENTS = {
    "ppo": lambda spec: ActorCritic(4, spec, hidden=(16,)),
    "sac": lambda spec: SACAgent(4, spec, hidden=(16,)),
}
every_kind = pytest.mark.parametrize("kind", SPECS)
every_agent = pytest.mark.parametrize("algorithm", AGENTS)


def pairs(kind, n=50):
    generator = torch.Generator().manual_seed(0)
    s = torch.randn(n, 4, generator=generator)
    chosen = (s[:, 0] > 0).long() + (s[:, 1] > 0).long()
    action = {"box": s[:, :2].tanh(), "discrete": chosen, "one_hot": F.one_hot(chosen, 3)}[kind]
    return TensorDict({"observation": s, "action": action}, [n])


def agent_of(algorithm, kind):
    torch.manual_seed(1)
    return AGENTS[algorithm](SPECS[kind])


@every_agent
@every_kind
def test_the_loss_is_that_of_the_action_that_is_taken(algorithm, kind):
    agent, data = agent_of(algorithm, kind), pairs(kind)
    loss = agent.imitation_loss(data["observation"], data["action"])
    assert loss.shape == (50,)
    greedy = agent.act(data["observation"], greedy=True)[0]
    if kind == "box":  # In units in which the bounds are -1 and 1, half of the environment's.
        expected = ((greedy - data["action"]) / 2).square().mean(-1)
        torch.testing.assert_close(loss, expected)
    else:
        index = data["action"] if kind == "discrete" else data["action"].argmax(-1)
        logits = agent.actor(data["observation"])
        torch.testing.assert_close(loss, F.cross_entropy(logits, index, reduction="none"))


@every_agent
@every_kind
def test_the_actor_comes_to_act_as_demonstrated(algorithm, kind):
    agent, data = agent_of(algorithm, kind), pairs(kind)
    trainer = CloningTrainer(agent, data, every=1, batch=32, lr=3e-3, seed=0)
    first = trainer.update(data[:1])["bc/loss"]
    assert trainer.update(torch.stack([data] * 8))["bc/loss"] < first
    last = agent.imitation_loss(data["observation"], data["action"]).mean().item()
    assert last < 0.4 * first


def test_frames():
    agent = PixelActorCritic(3, channels=2)
    frames = torch.randint(256, (6, 2, 84, 84), dtype=torch.uint8)
    action = torch.tensor([0, 1, 2, 0, 1, 2])
    data = TensorDict({"observation": frames, "action": action}, [6])
    assert CloningTrainer(agent, data, every=6, batch=4, seed=0).update(data)["bc/loss"] > 0


def test_steps_follow_environment_steps_whatever_the_batches():
    data = pairs("box")
    trainer = CloningTrainer(agent_of("sac", "box"), data, every=100, seed=0)
    taken = []
    trainer._step = lambda: taken.append(1) or torch.tensor(0.0)
    for size in (64, 64, 64, 8, 500):
        trainer.update(TensorDict(batch_size=[4, size // 4]))
    assert len(taken) == 7 and trainer.update(TensorDict(batch_size=[4, 1])) == {}
    assert trainer._taken == 704


@every_agent
def test_resumed_bit_for_bit(algorithm, tmp_path):
    data = pairs("box")

    def made():
        agent = agent_of(algorithm, "box")
        return agent, CloningTrainer(agent, data, every=40, batch=16, seed=3)

    agent, trainer = made()
    random = torch.get_rng_state()
    for _ in range(4):
        metrics = trainer.update(data)
    assert torch.equal(torch.get_rng_state(), random)
    half, first = made()
    for _ in range(2):
        first.update(data)
    save_state(
        tmp_path / "state.safetensors",
        {"agent": dict(half.state_dict()), "trainer": first.state_dict()},
    )
    state = load_state(tmp_path / "state.safetensors")
    other, resumed = made()
    other.load_state_dict(state["agent"])
    resumed.load_state_dict(state["trainer"])
    for _ in range(2):
        last = resumed.update(data)
    assert last == metrics
    for one, two in zip(agent.parameters(), other.parameters(), strict=True):
        assert torch.equal(one, two)
