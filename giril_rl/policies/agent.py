"""What acts in an environment: the interface of every agent, and its policy as a module."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from giril_rl.graphs import ModuleGraph, convolves
from giril_rl.runs.pretrained import Pretrained


class Agent(Pretrained, nn.Module):
    """A policy with whatever networks its algorithm trains beside it.

    Subclasses define ``acting_keys`` and :meth:`act`.
    """

    acting_keys: Sequence[str]
    """What :meth:`act` returns, by name; the first is ``"action"``."""
    samples_to_explore: bool = False
    """Whether it is to be scored by its most likely actions, having sampled to explore alone."""

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return next(self.parameters()).device

    def act(self, observation: Tensor, *, greedy: bool = False) -> tuple[Tensor, ...]:
        """Actions for raw observations ``(*batch, ...)``, and what else training needs of them.

        Args:
            observation: on :attr:`device`.
            greedy: takes the most likely action instead of sampling.
        """
        raise NotImplementedError

    def acting(self) -> ActingPolicy:
        """The module that acts in an environment. It shares this agent's parameters."""
        return ActingPolicy(self)

    def update_normaliser(self, observation: Tensor) -> None:
        """Merges raw observations into running statistics, if the agent has any."""


class ActingPolicy(TensorDictModuleBase):
    """Samples an action, or takes the mode under ``ExplorationType.DETERMINISTIC``.

    Reads ``"observation"`` and writes the agent's ``acting_keys`` on the observation's device,
    whatever the agent's device.

    Args:
        agent: what acts.

    Examples:
        >>> from tensordict import TensorDict
        >>> from giril_rl.policies import PixelActorCritic
        >>> frames = torch.zeros(3, 4, 84, 84, dtype=torch.uint8)
        >>> acted = ActingPolicy(PixelActorCritic(6))(TensorDict({"observation": frames}, [3]))
        >>> acted["action"].shape, acted["state_value"].shape
        (torch.Size([3]), torch.Size([3, 1]))
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.in_keys = ["observation"]
        self.out_keys = list(agent.acting_keys)
        self.agent = agent
        # In a tuple, which registers no parameter. Finding it at each step takes 5 microseconds.
        self._weights = (next(agent.parameters()),)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action for ``"observation"`` of any leading shape."""
        seen = tensordict.get("observation")
        out = self.act(seen.to(self._weights[0].device))
        for key, value in zip(self.out_keys, out, strict=True):
            tensordict.set(key, value.to(seen.device))
        return tensordict

    def act(self, observation: Tensor) -> Sequence[Tensor]:
        """What is written for observations on the agent's device."""
        greedy = exploration_type() == ExplorationType.DETERMINISTIC
        return self.agent.act(observation, greedy=greedy)


class RecordedActing(ActingPolicy):
    """An :class:`ActingPolicy` as one recorded graph. It always samples.

    It gives the same bits in about 60% of the time. See :class:`~giril_rl.graphs.ModuleGraph` for
    what may change between calls and what happens where no graph can be recorded.

    Args:
        agent: what acts.
        compile: compiles the graph, see :func:`giril_rl.graphs.compiling.compiled`; results are
            then equal up to rounding, and draws differ.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> from giril_rl.policies import ActorCritic
        >>> policy = RecordedActing(ActorCritic(4, Categorical(2, shape=(3,))))
        >>> policy(TensorDict({"observation": torch.zeros(3, 4)}, [3]))["action"].shape
        torch.Size([3])
    """

    def __init__(self, agent: Agent, *, compile: bool = False) -> None:
        super().__init__(agent)
        act = _Act(agent)

        def graph(state: dict[str, Tensor], inputs: Sequence[Tensor]) -> dict[str, Tensor]:
            out = torch.func.functional_call(act, state, tuple(inputs))
            return dict(zip(agent.acting_keys, out, strict=True))

        self._graph = ModuleGraph(act, graph, label="the policy's forward passes", compile=compile)

    def act(self, observation: Tensor) -> Sequence[Tensor]:
        """A draw for observations on the agent's device."""
        return self._graph.run([observation])[1]


def collecting(agent: Agent, *, compile: bool = False) -> ActingPolicy:
    """The policy that acts while training. It shares the agent's parameters.

    Args:
        agent: on the device where it stays.
        compile: see :class:`RecordedActing`.

    Returns:
        :class:`RecordedActing` if it is compiled, or for networks without convolutions on a CPU,
        which take less time than Python; else the agent's own acting policy.
    """
    if compile or (agent.device.type == "cpu" and not convolves(agent)):
        return RecordedActing(agent, compile=compile)
    return agent.acting()


class _Act(nn.Module):
    """:meth:`Agent.act` as a module's ``forward``, for :func:`torch.func.functional_call`."""

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.agent = agent

    def forward(self, observation: Tensor) -> tuple[Tensor, ...]:
        return self.agent.act(observation)
