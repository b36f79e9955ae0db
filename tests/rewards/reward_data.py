"""Random transitions of vectors and of frames, and the pixel networks' layers written out."""

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot

ACTIONS = 4
SPECS = {
    "box": Bounded(-2.0, 2.0, shape=(2,)),
    "discrete": Categorical(ACTIONS),
    "one_hot": OneHot(ACTIONS),
}
NESTED = [("agent", "observation"), ("agent", "action"), ("next", "agent", "observation")]


class Fixed(nn.Module):
    """A network that is a plain function of its inputs, concatenated."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, *x):
        return self.function(torch.cat(x, -1))


def vectors(*batch, kind="box"):
    """Transitions of three numbers, with actions beyond the bounds here and there."""
    if kind == "box":
        action = 3 * torch.randn(*batch, 2)
    else:
        action = torch.randint(ACTIONS, batch)
        if kind == "one_hot":
            action = F.one_hot(action, ACTIONS).bool()
    s, s_next = torch.randn(2, *batch, 3)
    return transition(s, action, s_next, batch)


def transition(s, action, s_next, batch=None):
    """A batch of these transitions; of the leading shape ``(n,)`` unless told otherwise."""
    entries = {"observation": s, "action": action, "next": {"observation": s_next}}
    return TensorDict(entries, s.shape[:1] if batch is None else batch)


def nested(batch):
    """The same under the keys of ``NESTED``."""
    moved = TensorDict(batch_size=batch.batch_size)
    for old, new in zip(["observation", "action", ("next", "observation")], NESTED, strict=True):
        moved[new] = batch[old]
    return moved


def sets(experts=5, policies=9, kind="box", shift=1.0):
    """Pairs of expert and policy, without the sub-dicts' batch sizes, which differ."""
    expert, policy = vectors(experts, kind=kind), vectors(policies, kind=kind)
    policy["observation"] += shift
    return TensorDict({"expert": expert.to_dict(), "policy": policy.to_dict()})


def total(out):
    """The sum of a loss's terms."""
    return sum(value for name, value in out.items() if name.startswith("loss_"))


def train(loss, batch, steps, lr, size=None, after=lambda out: None):
    """Adam on a batch or minibatches of it; the totals of all steps."""
    optimiser = torch.optim.Adam(loss.parameters(), lr=lr)
    totals = []
    for _ in range(steps):
        out = loss(batch if size is None else batch[torch.randint(len(batch), (size,))])
        optimiser.zero_grad()
        total(out).backward()
        optimiser.step()
        after(out)
        totals.append(total(out).item())
    return totals


def frames(*batch, side=84, seed=0):
    """Transitions of random stacks of four frames."""
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, 4, side, side)
    s, s_next = (
        torch.randint(256, shape, generator=generator, dtype=torch.uint8) for _ in range(2)
    )
    return transition(s, torch.randint(ACTIONS, batch, generator=generator), s_next, batch)


def scaled(frames):
    """Bytes on the scale of [-1, 1], as the paper has states."""
    return 2 * (frames.float() / 255) - 1


def convolved(body, x):
    """Table 2's four convolutions in eval mode, from the weights of ``body``."""
    convs = [layer for layer in body if isinstance(layer, nn.Conv2d)]
    norms = [layer for layer in body if isinstance(layer, nn.BatchNorm2d)]
    assert len(convs) == len(norms) == 4
    for conv, norm in zip(convs, norms, strict=True):
        x = F.conv2d(x, conv.weight, conv.bias, stride=2)
        mean, variance, gain, shift = (
            value[:, None, None]
            for value in (norm.running_mean, norm.running_var, norm.weight, norm.bias)
        )
        x = (x - mean) / (variance + 1e-5).sqrt() * gain + shift
        x = torch.where(x > 0, x, 0.01 * x)
    return x.flatten(1)


def decoded(decoder, code, s):
    """The decoder of Table 2 from its weights."""

    def leaky(x):
        return torch.where(x > 0, x, 0.01 * x)

    full = [layer for layer in decoder.painter if isinstance(layer, nn.Linear)]
    ups = [layer for layer in decoder.painter if isinstance(layer, nn.ConvTranspose2d)]
    x = code
    for layer in full:
        x = leaky(x @ layer.weight.T + layer.bias)
    x = x.view(-1, 64, 4, 4)
    for layer in ups[:-1]:
        x = leaky(F.conv_transpose2d(x, layer.weight, layer.bias, stride=2))
    x = F.conv_transpose2d(x, ups[-1].weight, ups[-1].bias)
    last = decoder.last
    return F.conv2d(torch.cat((x, s), 1), last.weight, last.bias, padding=2, dilation=2)


def run_in(loss, data, times=3):
    """Gives batch normalisation statistics that are not those it starts with."""
    loss.train()
    for _ in range(times):
        loss(data)
    return loss.eval()
