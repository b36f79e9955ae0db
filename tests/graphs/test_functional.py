"""TorchRL's losses that keep their parameters in TensorDictParams have their own gradients."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.objectives import SoftUpdate

from giril_rl.config.schema import SACConfig
from giril_rl.graphs import TracedGradients
from giril_rl.policies.soft_actor_critic import DRAWN, SACAgent
from giril_rl.training.sac import _loss

SPECS = {"box": Bounded(-1, 1, shape=(2,)), "int": Categorical(3), "one_hot": OneHot(3)}


def batch(agent, n=16):
    x, flag = torch.randn(n, 4), torch.rand(n, 1) < 0.3
    after = {"observation": torch.randn(n, 4), "reward": torch.randn(n, 1)}
    drawn = agent.random(n)
    return TensorDict(
        {
            "observation": x,
            "action" if agent.discrete else DRAWN: drawn,
            "next": {**after, "done": flag, "terminated": flag},
        },
        [n],
    )


@pytest.mark.parametrize("entropy", ["tuned", "fixed"])
@pytest.mark.parametrize("kind", SPECS)
def test_gradients_are_those_of_autograd_while_weights_and_targets_change(kind, entropy):
    torch.manual_seed(0)
    agent = SACAgent(4, SPECS[kind], hidden=[8])
    loss = _loss(agent, SACConfig(entropy=entropy))
    keys = ["observation", "action" if agent.discrete else DRAWN]
    keys += [("next", name) for name in ("observation", "reward", "done", "terminated")]
    step = TracedGradients(loss, keys=keys, log=("entropy",))
    optimizer = torch.optim.Adam(step.parameters, lr=0.05)
    targets = SoftUpdate(loss, tau=0.5)
    for number in range(4):
        data = batch(agent)
        torch.manual_seed(number)
        found = step(data)
        gradients = [p.grad.clone() for p in step.parameters]
        assert all(g.abs().max() > 0 for g in gradients), "a weight without a gradient"

        torch.manual_seed(number)
        loss.zero_grad()
        plain = loss(data.clone())
        sum(value for name, value in plain.items() if name.startswith("loss_")).backward()
        for gradient, parameter in zip(gradients, step.parameters, strict=True):
            torch.testing.assert_close(gradient, parameter.grad)
        torch.testing.assert_close(found["loss_qvalue"], plain["loss_qvalue"].detach())
        optimizer.step()
        targets.step()
