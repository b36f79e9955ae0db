"""``torch.compile`` for a recorded graph: with CUDA graphs on a GPU, and safe from Ctrl-C."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker

import torch
from torch import Tensor
from torch._dynamo.exc import TorchDynamoException

from giril_rl.errors import RunError, first_line


def compiled(
    graph: Callable[..., tuple[Tensor, ...]], device: torch.device
) -> Callable[..., tuple[Tensor, ...]]:
    """Compiles a graph for one shape. The first call is slow.

    The results equal the graph's up to rounding. Random operations draw other numbers from the same
    distribution: the compiler takes a seed from the global generator at each call.

    Args:
        graph: a function of tensors that does not branch on their values.
        device: where it runs. On CUDA, torch launches its kernels as one CUDA graph where it can.

    Raises:
        RunError: at the first call, if this machine cannot compile, for example without a C++
            compiler.
    """
    on_gpu = device.type == "cuda"
    function = torch.compile(
        graph, fullgraph=True, dynamic=False, options={"triton.cudagraphs": on_gpu}
    )
    called = False

    def run(*inputs: Tensor) -> tuple[Tensor, ...]:
        nonlocal called
        if on_gpu:
            torch.compiler.cudagraph_mark_step_begin()
        with contextlib.nullcontext() if called else _compiling():
            out = function(*inputs)
        called = True
        # The next run of a CUDA graph overwrites the memory of these results.
        return tuple(x.clone() for x in out) if on_gpu else out

    return run


@contextlib.contextmanager
def _compiling() -> Iterator[None]:
    """Blocks signals while the compiler's processes run, and turns its errors into one sentence.

    A terminal sends Ctrl-C to those processes too, and a library that is half written would stay in
    torch's cache. They inherit the blocked signals; this process stops at its next safe point.
    """
    masks = hasattr(signal, "pthread_sigmask")  # Windows cannot block signals.
    if masks:
        resource_tracker.ensure_running()  # If torch starts it, it unblocks the signals.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    except TorchDynamoException as error:
        raise RunError(
            f"torch could not compile the gradient steps ({first_line(error)}; --traceback shows "
            "all): give the same command without compile=true, or see whether a C++ compiler is "
            "installed, and for a GPU Triton; what was saved before is as it was."
        ) from error
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
