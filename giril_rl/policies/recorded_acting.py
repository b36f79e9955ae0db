"""The policy that collects, with as little Python around its network as can be."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from torch import Tensor, nn

from giril_rl.graphs import CannotRecord, record
from giril_rl.policies.acting import ActingPolicy
from giril_rl.policies.agents import Agent
from giril_rl.policies.policy import ActorCritic


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
    """An :class:`~giril_rl.policies.acting.ActingPolicy` as one recorded graph; it always samples.

    The same numbers from the same random ones, bit for bit, in some 60% of the time, which makes
    training on a simulator of tens of microseconds some 4% faster. Weights and statistics may
    change in place, as an optimizer and ``load_state_dict`` change them, but not be replaced. An
    agent of which no graph can be recorded acts without, which a warning says.

    Args:
        agent: policy and value network.
        compile: compiles the graph, see :func:`giril_rl.graphs.compiled.compiled`; the numbers
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
        self._attributes = vars(agent)  # Its "training" without a module's slow look-up.
        self._kind: tuple[torch.Size, bool] = (torch.Size(), False)
        self._state: list[Tensor] = []
        self._recorded = True

    def act(self, observation: Tensor) -> tuple[Tensor, ...]:
        """A draw for the observations; for another shape or mode of the agent recorded anew."""
        kind = observation.shape, self._attributes["training"]
        if self._graph is None or kind != self._kind:
            self._graph, self._kind = self._prepared(observation), kind
        return self._graph(observation, *self._state)

    def _prepared(self, observation: Tensor) -> Callable[..., tuple[Tensor, ...]]:
        named = {**dict(self._act.named_parameters()), **dict(self._act.named_buffers())}
        self._state = [x.detach() for x in named.values()]

        def eager(seen: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            return self._act(seen)

        def act(seen: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            given = dict(zip(named, state, strict=True))
            out = torch.func.functional_call(self._act, given, (seen,))
            if any(given[name] is not x for name, x in zip(named, state, strict=True)):
                raise CannotRecord("it puts another tensor in the place of a buffer")
            return out

        if self._recorded:
            inputs = [observation, *self._state]
            try:
                return record(act, inputs, eager=eager, compile=self._compile)
            except CannotRecord as error:
                self._recorded = False
                warnings.warn(
                    "the policy acts as it is, with the same numbers and more time in Python, for "
                    f"it cannot be recorded: {error}.",
                    stacklevel=2,
                )
        return eager


class _Act(nn.Module):
    """:meth:`ActorCritic.act` as the call of a module, whose state can be given to it."""

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.agent = agent

    def forward(self, observation: Tensor) -> tuple[Tensor, ...]:
        return self.agent.act(observation)
