"""A module's computation recorded once as a graph of tensor operations, then run without Python."""

from giril_rl.graphs.compiling import compiled
from giril_rl.graphs.gradients import TracedGradients
from giril_rl.graphs.recording import CannotRecord, ModuleGraph, convolves, record
from giril_rl.graphs.updates import CompiledUpdate

__all__ = [
    "CannotRecord",
    "CompiledUpdate",
    "ModuleGraph",
    "TracedGradients",
    "compiled",
    "convolves",
    "record",
]
