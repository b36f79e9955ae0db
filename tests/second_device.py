"""A device that no machine lacks: tensors on it have no values, and refuse to meet the CPU's.

torch's FakeTensorMode computes shapes, types and devices alone, by the rules that hold on a GPU: an
operation on tensors of two devices is an error, and so is looking at a value (``item``, ``if``).
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.symbolic_shapes import ShapeEnv

DEVICE = torch.device("meta")


class SecondDevice:
    """Modules and batches on it.

    Args:
        mode: the mode that its tensors belong to.
    """

    def __init__(self, mode: FakeTensorMode) -> None:
        self.mode = mode

    def take(self, module: nn.Module) -> nn.Module:
        """Moves a module in place, as ``module.to("cuda")`` does."""
        for part in module.modules():
            for name, parameter in part._parameters.items():
                if parameter is not None:
                    moved = self.tensor(parameter).detach()
                    part._parameters[name] = nn.Parameter(moved, parameter.requires_grad)
            for name, buffer in part._buffers.items():
                if buffer is not None:
                    part._buffers[name] = self.tensor(buffer)
        return module

    def tensor(self, tensor: Tensor) -> Tensor:
        """A copy of a tensor there."""
        return self.mode.from_tensor(tensor).to(DEVICE)

    def batch(self, batch: TensorDictBase) -> TensorDictBase:
        """A copy of a batch there."""
        moved = batch.apply(self.tensor, device=DEVICE)
        assert isinstance(moved, TensorDict)
        return moved


@contextmanager
def second_device(*, values: bool = False) -> Iterator[SecondDevice]:
    """Inside, tensors without values are made, on either device.

    Args:
        values: lets the host ask for values, as for metrics, and gives it an unknown number.
    """
    asked = {"allow_dynamic_output_shape_ops": True, "allow_scalar_outputs": True}
    shapes = ShapeEnv(**asked) if values else None
    with FakeTensorMode(shape_env=shapes, static_shapes=True) as mode:
        yield SecondDevice(mode)
