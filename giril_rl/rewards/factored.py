"""GIRIL's reward for pixels at beta = 1, without running the decoder per transition."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.networks.rows import ROWS, rows_kernel

HALF_RANGE = 127.5


@torch.no_grad()
def factored_error(
    table: Tensor,
    state_weight: Tensor,
    action: Tensor,
    observation: Tensor,
    following: Tensor,
    *,
    clamp: bool = True,
    chunk: int | None = None,
) -> Tensor:
    """``||s_hat - s'||^2`` (paper, eq. 2, beta = 1, lambda = 1), per transition, without gradient.

    ``s_hat = table[a] + conv(s)``, which is the whole decoder, for the action enters it before its
    last layer and the state only there, see
    :class:`~giril_rl.networks.pixel_decoder.PixelDecoder`. States are scaled to [-1, 1] by
    ``x / 127.5 - 1`` first, and the convolution pads the scaled state with 0.

    Args:
        table: the decoder's ``action_table()``, ``(actions, channels, height, width)``; the height
            is a multiple of 4.
        state_weight: the decoder's ``state_weight``, ``(channels, channels, 3, 3)``, dilation 2.
        action: integers ``(*batch,)``.
        observation: s, uint8, ``(*batch, channels, height, width)``.
        following: s', likewise.
        clamp: clamp the prediction to [-1, 1], as scaled states are.
        chunk: transitions computed at a time; None takes 16 on a CPU, few enough for what is in
            between to stay in its cache, and 1,024 elsewhere.

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
    for frames in (observation, following):
        if frames.shape != (*batch, *frame):
            raise UserError(
                f"frames have shape {tuple(frames.shape)} where {(*batch, *frame)} is needed: "
                "channels come before height and width."
            )
    action = action.reshape(-1).long()
    observation, following = (x.reshape(-1, *frame) for x in (observation, following))
    table = _deal(_raw_table(table, state_weight)).flatten(1, 2)
    kernel = rows_kernel(state_weight, dilation=2)
    if chunk is None:
        chunk = 16 if table.device.type == "cpu" else 1024
    chunk = min(chunk, max(len(action), 1))
    # Memory written again and again stays in the cache; new memory for each chunk would not.
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


def _raw_table(table: Tensor, weight: Tensor) -> Tensor:
    """The table for states in 0..255 and a prediction on the same scale.

    ``conv(s / 127.5 - 1) = conv(s) / 127.5 - conv(1)``, all padded with 0: near a border fewer
    weights meet the ones, so what the scaling's constant is worth is an image, not a number.
    """
    ones = torch.ones_like(table[:1])
    return HALF_RANGE * (table + 1 - F.conv2d(ones, weight, padding=2, dilation=2))


def _deal(images: Tensor) -> Tensor:
    """A view of ``(N, c, h, w)`` as ``(N, c, 4, h / 4, w)``, the rows dealt out in turns."""
    return images.unflatten(2, (-1, ROWS)).transpose(2, 3)
