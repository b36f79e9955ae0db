"""GIRIL's reward for pixels without running the decoder per transition.

The action enters the decoder before its last layer and the state only there, so that the decoder
is a sum of two parts, see :class:`~giril_rl.networks.pixel_decoder.PixelDecoder`.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from giril_rl.errors import UserError
from giril_rl.networks.pixel_decoder import ROWS, PixelDecoder, rows_kernel
from giril_rl.rewards.scaler import PixelScaler

HALF_RANGE = 127.5


@torch.no_grad()
def factored_error(
    table: Tensor,
    state_weight: Tensor,
    action: Tensor,
    observation: Tensor,
    next_observation: Tensor,
    *,
    clamp: bool = True,
    chunk: int | None = None,
) -> Tensor:
    """``||s_hat - s'||^2`` with ``s_hat = table[a] + conv(s)`` (paper, eq. 2), without gradient.

    States are scaled to [-1, 1] by ``x / 127.5 - 1``, and the convolution pads the scaled state
    with 0.

    Args:
        table: the decoder's ``action_table()``, ``(actions, channels, height, width)``; the height
            is a multiple of 4.
        state_weight: the decoder's ``state_weight``, ``(channels, channels, 3, 3)``, dilation 2.
        action: integers ``(*batch,)``.
        observation: s, uint8, ``(*batch, channels, height, width)``.
        next_observation: s', likewise.
        clamp: clamp the prediction to [-1, 1], as scaled states are.
        chunk: transitions computed at a time; None means 16 on a CPU, so that intermediate results
            stay in its cache, and 1,024 elsewhere.

    Returns:
        The error ``(*batch,)``.

    Raises:
        UserError: for observations of another shape.

    Examples:
        >>> table, weight = torch.zeros(2, 4, 84, 84), torch.zeros(4, 4, 3, 3)
        >>> white = torch.full((3, 4, 84, 84), 255, dtype=torch.uint8)
        >>> factored_error(table, weight, torch.tensor([0, 1, 1]), white, white).round().tolist()
        [28224.0, 28224.0, 28224.0]
    """
    batch, frame = action.shape, table.shape[1:]
    for frames in (observation, next_observation):
        if frames.shape != (*batch, *frame):
            raise UserError(
                f"frames have shape {tuple(frames.shape)} where {(*batch, *frame)} is needed: "
                "channels come before height and width."
            )
    action = action.reshape(-1).long()
    observation, following = (x.reshape(-1, *frame) for x in (observation, next_observation))
    table = _deal(_raw_table(table, state_weight)).flatten(1, 2)
    kernel = rows_kernel(state_weight, dilation=2)
    if chunk is None:
        chunk = 16 if table.device.type == "cpu" else 1024
    chunk = min(chunk, max(len(action), 1))
    # Reused memory stays in the cache; new memory for each chunk would not.
    state, offset = (table.new_empty(chunk, *shape) for shape in (frame, table.shape[1:]))
    errors = table.new_empty(len(action))
    for start in range(0, len(action), chunk):
        some = slice(start, start + chunk)
        size = len(action[some])
        state[:size].copy_(observation[some])
        predicted = F.conv2d(state[:size], kernel, stride=(ROWS, 1), padding=2, dilation=(1, 2))
        torch.index_select(table, 0, action[some], out=offset[:size])
        predicted.add_(offset[:size])
        if clamp:
            predicted.clamp_(0, 2 * HALF_RANGE)
        predicted.unflatten(1, (-1, ROWS)).sub_(_deal(following[some]))
        torch.sum(predicted.square_(), (1, 2, 3), out=errors[some])
    return errors.div_(HALF_RANGE**2).reshape(batch)


def coded_error(
    decoder: PixelDecoder,
    encoding: Tensor,
    observation: Tensor,
    next_observation: Tensor,
    *,
    clamp: bool,
) -> Tensor:
    """:func:`factored_error` for encodings ``(*batch, actions)`` that differ by transition."""
    batch = encoding.shape[:-1]
    return factored_error(
        decoder.code_part(encoding.reshape(-1, encoding.shape[-1])),
        decoder.state_weight,
        torch.arange(batch.numel(), device=encoding.device).reshape(batch),
        observation,
        next_observation,
        clamp=clamp,
    )


def _raw_table(table: Tensor, weight: Tensor) -> Tensor:
    """The table for states in 0..255 and a prediction on the same scale.

    ``conv(s / 127.5 - 1) = conv(s) / 127.5 - conv(1)``, all padded with 0. Near a border fewer
    weights meet the ones, so ``conv(1)`` is an image rather than a number.
    """
    ones = torch.ones_like(table[:1])
    return HALF_RANGE * (table + 1 - F.conv2d(ones, weight, padding=2, dilation=2))


def _deal(images: Tensor) -> Tensor:
    """A view of ``(N, c, h, w)`` as ``(N, c, 4, h / 4, w)``, every fourth row together."""
    return images.unflatten(2, (-1, ROWS)).transpose(2, 3)


class ActionTable:
    """A decoder's ``action_table`` and ``state_weight``, cached until its weights change.

    It compares the weights' values, which takes 0.2 ms against 110 ms for a new table: a fused
    optimiser's step does not change a tensor's version. On other devices than a CPU the table is
    computed anew, which takes less time than waiting for a comparison.

    Examples:
        >>> decoder, table = PixelDecoder(4), ActionTable()
        >>> images, weight = table(decoder)
        >>> images.shape, table(decoder)[0] is images
        (torch.Size([4, 4, 84, 84]), True)
    """

    def __init__(self) -> None:
        self._weights: list[Tensor] = []
        self._images: Tensor | None = None

    @torch.no_grad()
    def __call__(self, decoder: PixelDecoder) -> tuple[Tensor, Tensor]:
        """Images ``(actions, channels, 84, 84)`` and weights ``(channels, channels, 3, 3)``."""
        weights = list(decoder.parameters())
        if weights[0].device.type != "cpu":
            return decoder.action_table(), decoder.state_weight
        if self._images is None or not all(map(_same, self._weights, weights)):
            self._weights = [weight.clone() for weight in weights]
            self._images = decoder.action_table()
        return self._images, decoder.state_weight


def _same(one: Tensor, other: Tensor) -> bool:
    alike = (one.device, one.dtype) == (other.device, other.dtype)
    return alike and torch.equal(one, other)


def is_factored(
    decoder: nn.Module, scaler: nn.Module, observation: Tensor, next_observation: Tensor
) -> bool:
    """Whether the decoder's parts may be computed separately: exact, but without gradient."""
    return (
        computes_as(decoder, PixelDecoder)
        and computes_as(scaler, PixelScaler)
        and observation.dtype == next_observation.dtype == torch.uint8
        and not torch.is_grad_enabled()
    )


def computes_as(module: nn.Module, kind: type[nn.Module]) -> bool:
    """Whether a module has the ``forward`` of ``kind``; a subclass may have another."""
    return getattr(module.forward, "__func__", None) is kind.forward
