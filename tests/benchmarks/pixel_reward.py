"""Transitions per second of GIRIL's pixel reward: the whole decoder and its two parts in turns.

python tests/benchmarks/pixel_reward.py [--threads 1] [--batch 1024] [--actions 4] [--rounds 3]
"""

from __future__ import annotations

import argparse
import copy
import statistics
import time
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Categorical

from giril_rl.networks.pixel_decoder import PixelDecoder
from giril_rl.rewards import GenerativeReward
from giril_rl.rewards.factored import factored_error
from giril_rl.rewards.generative import reconstruction_error
from giril_rl.rewards.transitions import PIXELS_AT_ONCE


def plain(decoder: PixelDecoder) -> PixelDecoder:
    """The same network of torch's own layers."""
    copied = copy.deepcopy(decoder)
    for i, layer in enumerate(copied.painter):
        if isinstance(layer, nn.ConvTranspose2d):
            side, stride = layer.kernel_size[0], int(layer.stride[0])
            own = nn.ConvTranspose2d(layer.in_channels, layer.out_channels, side, stride=stride)
            own.load_state_dict(layer.state_dict())
            copied.painter[i] = own
        elif isinstance(layer, nn.Unflatten):
            copied.painter[i] = nn.Unflatten(1, layer.unflattened_size)
    return copied


def literal_error(
    decoder: PixelDecoder, action: Tensor, observation: Tensor, following: Tensor, chunk: int
) -> Tensor:
    """Eq. 2 at beta = 1 with the decoder run for every transition."""
    codes = torch.eye(decoder.actions)
    errors = []
    for some in torch.arange(len(action)).split(chunk):
        s, after = (x[some[0] : some[-1] + 1].float() / 127.5 - 1 for x in (observation, following))
        image = decoder.painter(codes[action[some]])  # All at once, as a network is called.
        predicted = decoder.last(torch.cat((image, s), 1)).clamp_(-1, 1)
        errors.append(predicted.sub_(after).square_().sum((1, 2, 3)))
    return torch.cat(errors)


def seconds(function: Callable[[], Tensor]) -> float:
    """How long one call takes."""
    began = time.perf_counter()
    function()
    return time.perf_counter() - began


@torch.no_grad()
def main() -> None:
    """Time both and print the medians."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--actions", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--chunk", type=int, default=16, help="of the factored form")
    parser.add_argument("--literal-chunk", type=int, default=0, help="0: all at once")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    decoder = PixelDecoder(args.actions)
    shape = (args.batch, 4, 84, 84)
    observation, following = (torch.randint(256, shape, dtype=torch.uint8) for _ in range(2))
    data = (torch.randint(args.actions, (args.batch,)), observation, following)

    torchs = plain(decoder)

    def literal() -> Tensor:
        return literal_error(torchs, *data, args.literal_chunk or args.batch)

    def factored() -> Tensor:
        return factored_error(table, decoder.state_weight, *data, chunk=args.chunk)

    # A reward needs the table once per update of its model, so it is timed by itself.
    table = decoder.action_table()
    slow, fast = literal(), factored()
    difference = ((fast - slow) / slow).abs().max().item()
    times = [(seconds(literal), seconds(factored)) for _ in range(args.rounds)]
    tables = [seconds(decoder.action_table) for _ in range(args.rounds)]
    for name, taken in zip(("literal", "factored"), zip(*times, strict=True), strict=True):
        print(f"{name:<10}{args.batch / statistics.median(taken):12,.0f} transitions/s")
    print(f"the table takes {statistics.median(tables) * 1e3:.1f} ms, once")
    ratio = statistics.median(a / b for a, b in times)
    print(f"factored is {ratio:.1f} times as fast; largest relative difference {difference:.1e}")
    blended(args.rounds, *data)


def blended(rounds: int, action: Tensor, observation: Tensor, following: Tensor) -> None:
    """Prints the same of beta = 0.9, encoder included, where each transition has its own code."""
    actions = int(action.max()) + 1
    reward = GenerativeReward.for_pixels(Categorical(actions), beta=0.9).eval()
    torchs = copy.deepcopy(reward)
    torchs.decoder = plain(reward.decoder)
    data = {"observation": observation, "action": action, "next": {"observation": following}}
    batch = TensorDict(data, [len(action)])

    def literal() -> Tensor:
        split = (x.split(PIXELS_AT_ONCE) for x in (observation, action, following))
        parts = zip(*split, strict=True)
        scale = reward.scaler
        return torch.cat(
            [
                reconstruction_error(torchs.predict(s, a, after), scale(after), 3)
                for s, a, after in parts
            ]
        )

    def in_parts() -> Tensor:
        return reward(batch)["next", "intrinsic_reward"].squeeze(-1)

    slow = literal()
    difference = ((in_parts() - slow) / slow).abs().max().item()
    times = [(seconds(literal), seconds(in_parts)) for _ in range(rounds)]
    for name, taken in zip(("literal", "in parts"), zip(*times, strict=True), strict=True):
        rate = len(action) / statistics.median(taken)
        print(f"{name:<10}{rate:12,.0f} transitions/s at beta = 0.9")
    ratio = statistics.median(a / b for a, b in times)
    print(f"in parts is {ratio:.1f} times as fast; largest relative difference {difference:.1e}")


if __name__ == "__main__":
    main()
