"""The policy that collects, with as little Python around its network as can be."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from giril_rl.networks.acting import ActingPolicy
from giril_rl.networks.agents import Agent
from giril_rl.networks.policy import ActorCritic
from giril_rl.training.recorded import record


def collecting(agent: Agent, *, compile: bool = False) -> ActingPolicy:
    """The module that acts while training: always samples, shares the agent's parameters.

    Args:
        agent: where its weights are for good; its networks run there.
        compile: see :class:`RecordedActing`.

    Returns:
        :class:`RecordedActing` where it is compiled, and for vectors on a CPU, where Python takes
        longer than the network; the agent's own acting policy otherwise.
    """
    if compile or (isinstance(agent, ActorCritic) and agent.device.type == "cpu"):
        return RecordedActing(agent, compile=compile)
    return agent.acting()


class RecordedActing(ActingPolicy):
    """An :class:`~giril_rl.networks.acting.ActingPolicy` as one recorded graph; it always samples.

    The same numbers from the same random ones, bit for bit, in some 60% of the time, which makes
    training on a simulator of tens of microseconds some 4% faster. Weights and statistics may
    change in place, as an optimizer and ``load_state_dict`` change them, but not be replaced.

    Args:
        agent: policy and value network.
        compile: compiles the graph, see :func:`giril_rl.training.compiled.compiled`; the numbers
            are then those to rounding, and drawn otherwise.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> policy = RecordedActing(ActorCritic(4, Categorical(2, shape=(3,))))
        >>> policy(TensorDict({"observation": torch.zeros(3, 4)}, [3]))["action"].shape
        torch.Size([3])
    """

    def __init__(self, agent: Agent, *, compile: bool = False) -> None:
        super().__init__(agent)
        self._act = _Act(agent)
        self._compile = compile
        self._graph: Callable[..., tuple[Tensor, ...]] | None = None
        self._shape = torch.Size()
        self._state: list[Tensor] = []

    def act(self, observation: Tensor) -> tuple[Tensor, ...]:
        """A draw for the observations; another shape of them is recorded anew."""
        if self._graph is None or observation.shape != self._shape:
            self._graph = self._record(observation)
        return self._graph(observation, *self._state)

    def _record(self, observation: Tensor) -> Callable[..., tuple[Tensor, ...]]:
        named = {**dict(self._act.named_parameters()), **dict(self._act.named_buffers())}
        self._state = [x.detach() for x in named.values()]
        self._shape = observation.shape

        def act(seen: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            given = dict(zip(named, state, strict=True))
            return torch.func.functional_call(self._act, given, (seen,))

        return record(act, [observation, *self._state], compile=self._compile)


class _Act(nn.Module):
    """:meth:`ActorCritic.act` as the call of a module, whose state can be given to it."""

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.agent = agent

    def forward(self, observation: Tensor) -> tuple[Tensor, ...]:
        return self.agent.act(observation)
