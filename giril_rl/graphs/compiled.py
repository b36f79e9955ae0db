"""A recorded graph compiled by torch, for a GPU as a CUDA graph."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker

import torch
from torch import Tensor
from torch._dynamo.exc import TorchDynamoException

from giril_rl.errors import RunError


def compiled(
    graph: Callable[..., tuple[Tensor, ...]], device: torch.device
) -> Callable[..., tuple[Tensor, ...]]:
    """:func:`torch.compile` for one shape, which takes its time at the first call.

    The numbers are the graph's to rounding. Random ones are others of the same distribution, as
    repeatable: torch's compiler draws a seed from the global generator at each call.

    Args:
        graph: a function of plain tensors that looks at no value.
        device: where it runs. On CUDA its kernels are launched as one graph, where torch finds that
            it can be.

    Raises:
        RunError: at the first call, if this machine cannot compile it, for want of a C++ compiler
            for example.

    Examples:
        >>> double = compiled(lambda x: (x + x,), torch.device("cpu"))
        >>> double(torch.tensor([1.0, 3.0]))  # doctest: +SKIP
        (tensor([2., 6.]),)
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
        # A CUDA graph's next run writes where this one's results are.
        return tuple(x.clone() for x in out) if on_gpu else out

    return run


@contextlib.contextmanager
def _compiling() -> Iterator[None]:
    """Keeps Ctrl-C from the compiler's processes, and tells in a sentence what went wrong.

    A terminal sends Ctrl-C to them as well, and the library that one was writing would stay in
    torch's cache, broken. They inherit which signals are blocked; this process stops at the next
    safe point, as ever.
    """
    masks = hasattr(signal, "pthread_sigmask")  # Windows has no signals to block.
    if masks:
        resource_tracker.ensure_running()  # Where that is left to torch, it unblocks the signals.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    except TorchDynamoException as error:
        reason = str(error).strip().partition("\n")[0]
        raise RunError(
            f"torch could not compile the gradient steps ({reason}; --traceback shows all): give "
            "the same command without compile=true, or see whether a C++ compiler is installed, "
            "and for a GPU Triton; what was saved before is as it was."
        ) from error
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
