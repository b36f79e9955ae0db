"""What every reward module has to hold, present and future: register it, and it is checked.

A reward reads transitions and writes one number for each. A :class:`reward_cases.Case` says how one
is built and what it claims. The ``check_*`` functions hold it to what holds for all and to its own
claims: an entry that it says it does not read must not matter.
"""

import copy

import torch
from reward_cases import (
    ENTRIES,
    NESTED,
    PLAIN,
    Case,
    assert_equal,
    build,
    far_away,
    rewards,
    transitions,
)
from reward_worlds import MakeEnv, world_of
from second_device import DEVICE, second_device
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from giril_rl.runs.checkpoint import load_state, save_state
from giril_rl.transforms import IntrinsicReward


def check_one_value_per_transition(case: Case) -> None:
    """Shape ``(*batch, 1)``, floats, finite also for states that no expert saw."""
    module = build(case)
    for shape in [(), (1,), (5,), (2, 3), (2, 3, 4)]:
        value = rewards(module, transitions(case, *shape))
        assert value.shape == (*shape, 1)
        assert value.dtype == torch.float32
    assert rewards(module, far_away(case, 5)).isfinite().all()


def check_batch_shape_does_not_matter(case: Case) -> None:
    """``[B]``, ``[N, T]`` and single transitions get the same numbers."""
    module, batch = build(case), transitions(case, 4, 6)
    whole = rewards(module, batch)
    assert_equal(rewards(module, batch.reshape(24)), whole.reshape(24, 1))
    assert_equal(rewards(module, batch.reshape(2, 2, 6)), whole.reshape(2, 2, 6, 1))
    if case.deterministic:  # A generator's n-th draw depends on how many are drawn at once.
        for i, j in ((0, 0), (1, 4), (3, 5)):
            assert_equal(rewards(module, batch[i, j]), whole[i, j])


def check_environments_are_independent(case: Case) -> None:
    """Rewards follow their transitions, and no environment's depends on another's."""
    module, batch = build(case), transitions(case, 4, 6)
    whole = rewards(module, batch)
    if case.deterministic:  # Noise belongs to a place in the batch.
        order = torch.tensor([2, 0, 3, 1])
        assert_equal(rewards(module, batch[order]), whole[order])
        assert_equal(rewards(module, batch[1:2]), whole[1:2])
    other = batch.clone()
    other[2] = transitions(case, 6, seed=1)
    changed = rewards(module, other)
    same = [0, 1, 3]
    assert_equal(changed[same], whole[same])
    if case.claims(module):
        assert (changed[2] != whole[2]).all()


def check_depends_on_what_it_says(case: Case) -> None:
    """Each entry of one transition changes that one's reward, or none if it is not claimed."""
    module, batch = build(case), transitions(case, 8)
    whole, claimed = rewards(module, batch), case.claims(module)
    for entry in ENTRIES:
        other = batch.clone()
        value = other.get(PLAIN[entry])
        value[3] = (value[3] + 1) % 3 if entry == "action" and case.discrete else value[3] * 0.7
        changed = (rewards(module, other) != whole).squeeze(-1)
        assert changed.tolist() == [i == 3 and entry in claimed for i in range(8)], entry


def check_no_gradient_reaches_the_policy(case: Case) -> None:
    """Not even from a reward in training, of an action that carries a gradient."""
    module, batch = build(case).train(), transitions(case, 8)
    batch["next", "reward"] = torch.zeros(8, 1)
    if not case.pixels:
        batch["observation"].requires_grad_()
    if not case.discrete:
        batch["action"] = batch["action"].requires_grad_() * 0.5
    out = IntrinsicReward(module)(batch)
    assert not out["next", "reward"].requires_grad
    assert module.training


def check_evaluation_leaves_no_trace(case: Case) -> None:
    """Weights, statistics, the batch and the global random state stay; noise moves on."""
    module, batch = build(case), transitions(case, 8)
    batch["next", "reward"] = torch.zeros(8, 1)
    before, given = copy.deepcopy(tensors(module)), batch.clone()
    random = torch.get_rng_state()
    transform = IntrinsicReward(module, extrinsic_key=None)
    first = transform(batch)["next", "reward"].clone()
    after = tensors(module)
    assert before.keys() == after.keys()
    moved = {name for name, value in before.items() if not torch.equal(value, after[name])}
    assert torch.equal(torch.get_rng_state(), random)
    for key in given.exclude(("next", "reward")).keys(True, True):
        assert torch.equal(batch[key], given[key])
    second = transform(batch)["next", "reward"]
    if case.deterministic:
        assert not moved
        assert torch.equal(second, first)
    else:
        assert moved and all(name.endswith("_extra_state") for name in moved)
        assert not torch.equal(second, first)


def tensors(module: TensorDictModuleBase) -> dict[str, torch.Tensor]:
    """All that a module holds, whether or not it is saved."""
    return {**dict(module.named_buffers()), **module.state_dict()}


def check_state_round_trip(case: Case, folder) -> None:
    """A file brings an unfitted module to the same rewards: weights, statistics and noise."""
    module, batch = build(case, seed=1), transitions(case, 8)
    module(batch.clone())  # Noise that has been drawn from before.
    expected = rewards(module, batch)
    save_state(folder / "reward.safetensors", dict(module.state_dict()))
    other = build(case, seed=2, fit=False)
    other.load_state_dict(load_state(folder / "reward.safetensors"))
    assert torch.equal(rewards(other, batch), expected)
    if module.state_dict():  # Weights or statistics decide its value.
        assert not torch.equal(rewards(build(case, seed=2), batch), expected)


def check_another_device(case: Case) -> None:
    """Where its weights are, it takes a batch and answers, and waits for no value on the way."""
    module, batch = build(case).eval(), transitions(case, 2, 3)
    with second_device() as device, torch.no_grad():
        device.take(module)
        assert module(device.batch(batch)).get(PLAIN["reward"]).device == DEVICE


def check_nested_keys(case: Case) -> None:
    """Keys of any depth, the reward's included, give the same numbers."""
    plain, nested = build(case), build(case, keys=NESTED)
    batch, moved = transitions(case, 8), transitions(case, 8, keys=NESTED)
    assert nested.out_keys == [NESTED["reward"]]
    assert_equal(rewards(nested, moved, NESTED), rewards(plain, batch))
    moved["next", "reward"] = torch.zeros(8, 1)
    out = IntrinsicReward(copy.deepcopy(nested))(moved)
    assert_equal(out["next", "reward"], rewards(plain, batch))


def check_environment_and_batch_agree(case: Case, make_env: MakeEnv) -> None:
    """The same numbers step by step in an environment as on the batch that it gave."""
    module, world = build(case), world_of(case, make_env)
    batch = IntrinsicReward(module)(world.played.clone())
    env = TransformedEnv(world.env(), IntrinsicReward(copy.deepcopy(module)))
    stepped = world.play(env)
    assert_equal(stepped["next", "extrinsic_reward"], batch["next", "extrinsic_reward"])
    assert stepped["next", "reward"].shape == batch["next", "reward"].shape
    if case.deterministic:
        assert_equal(stepped["next", "reward"], batch["next", "reward"])


def check_terminal_step(case: Case, make_env: MakeEnv) -> None:
    """The last step of an episode is worth what its true end makes of it, not the next start."""
    module, world = build(case), world_of(case, make_env)
    batch = world.played.clone()
    true = batch.select("observation", "action")
    true["next"] = {"observation": world.true_next, "terminated": batch["next", "terminated"]}
    expected = rewards(module, true)
    relabelled = IntrinsicReward(copy.deepcopy(module))(batch)["next", "reward"]
    assert_equal(relabelled, expected)
    # A reward that is told of failures may leave out what follows one.
    told = ("next", "terminated") in module.in_keys
    if "next_observation" in case.claims(module) and not told:
        done = batch["next", "done"].squeeze(-1)
        wrong = true.clone()
        wrong["next", "observation"][done] = world.next_start[done]
        differs = (rewards(module, wrong) != expected).squeeze(-1)
        assert torch.equal(differs, done)
