import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical

from giril_rl.demos import Demonstration, check_demonstration
from giril_rl.errors import UserError

DONE, LAST = ("next", "done"), ("next", "truncated")


def edit(demo, key, change):
    data = demo.transitions.clone()
    if (changed := change(data.get(key).clone())) is None:
        data.del_(key)
    else:
        data.set(key, changed)
    return Demonstration(data, demo.card)


def put(index, value):
    def change(tensor):
        tensor[index] = value
        return tensor

    return change


def test_sound_demonstrations_pass(demo, whole):
    spec = Bounded(-1.0, 1.0, (16, 1))
    check_demonstration(demo, observation_dim=2, action_spec=spec)
    check_demonstration(whole, observation_dim=2, action_spec=spec[0])


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("action", lambda x: None, "has no 'action'"),
        (("next", "reward"), lambda x: None, r"has no 'next\.reward'"),
        ("observation", lambda x: x.double(), "observation of torch.float64"),
        (
            "observation",
            lambda x: x[:, None],
            r"observation of torch.float32 and shape \[12, 1, 2\]",
        ),
        ("action", lambda x: x[:, 0], r"action of torch.float32 .* must be torch.int64 \[12\]"),
        (("next", "reward"), lambda x: x[:, 0], r"next.reward .* must be torch.float32 \[12, 1\]"),
        (DONE, lambda x: x.float(), r"next.done of torch.float32 .* torch.bool \[12, 1\]"),
        ("step", lambda x: x.int(), "step of torch.int32"),
        ("action", put(7, torch.nan), "NaN or infinity in action at index 7"),
        (("next", "observation"), put(11, torch.inf), "in next.observation at index 11"),
        (("next", "observation"), lambda x: x[:, :1], "different shapes"),
        ("observation", put((3, 1), 9.0), r"next\.observation\[2\] is not observation\[3\]"),
        ("observation", lambda x: x.roll(1, 0), r"next\.observation\[0\] is not observation\[1\]"),
        ("episode", put(slice(5, 12), 2), "episode 2 out of order at index 5"),
        ("episode", put(slice(0, 12), 1), "episode 1 out of order at index 0"),
        ("episode", put(7, 0), "episode 0 out of order at index 7"),
        ("episode", put(slice(5, 10), 0), "episode 2 out of order at index 10"),
        ("step", put(8, 5), "step 5 of episode 1 out of order at index 8"),
        ("step", put(0, 1), "step 1 of episode 0 out of order at index 0"),
        (DONE, put(4, False), "done at index 4 that is not terminated or truncated"),
    ],
)
def test_each_fault_is_named(demo, key, change, message):
    with pytest.raises(UserError, match=message):
        check_demonstration(edit(demo, key, change))


def test_done_in_the_middle_and_lost_ends(demo, whole):
    early = edit(edit(demo, DONE, put(2, True)), LAST, put(2, True))
    with pytest.raises(
        UserError, match="goes on after done at index 2, in the middle of episode 0"
    ):
        check_demonstration(early)
    lost = edit(edit(demo, DONE, put(4, False)), ("next", "terminated"), put(4, False))
    with pytest.raises(UserError, match="episode 0 that stops at index 4 without done"):
        check_demonstration(lost)
    # Only a recording of fixed length may be cut, and only at its end.
    cut = Demonstration(whole.transitions[:8], whole.card)
    with pytest.raises(UserError, match="episode 1 that stops at index 7 without done"):
        check_demonstration(cut)
    check_demonstration(Demonstration(whole.transitions[:8], {**whole.card, "length": 8}))


def test_swapped_transitions_are_misaligned(demo):
    order = torch.tensor([0, 2, 1, *range(3, 12)])
    data = demo.transitions[order]
    data["step"] = demo.transitions["step"]
    with pytest.raises(UserError, match=r"misaligned: next\.observation\[0\]"):
        check_demonstration(Demonstration(data, demo.card))


def test_empty_is_refused(demo):
    with pytest.raises(UserError, match="empty"):
        check_demonstration(Demonstration(demo.transitions[:0], demo.card))
    with pytest.raises(UserError, match="has no 'observation'"):
        check_demonstration(Demonstration(TensorDict({}, [0]), {}))


def test_task_must_fit(demo):
    with pytest.raises(UserError, match="2 numbers in an observation and the task has 5"):
        check_demonstration(demo, observation_dim=5)
    with pytest.raises(UserError, match="1 numbers in an action and the task has 3"):
        check_demonstration(demo, action_spec=Bounded(-1.0, 1.0, (3,)))
    with pytest.raises(UserError, match="continuous actions and the task discrete"):
        check_demonstration(demo, action_spec=Categorical(3))
    with pytest.raises(UserError, match=r"action \[0\.1875\] at index 1, outside"):
        check_demonstration(demo, action_spec=Bounded(-0.1, 0.1, (16, 1)))


def test_discrete_action_out_of_range(demo):
    discrete = edit(demo, "action", lambda x: torch.arange(12) % 3)
    check_demonstration(discrete, action_spec=Categorical(3, shape=(16,)))
    with pytest.raises(UserError, match="action 2 at index 2, outside"):
        check_demonstration(discrete, action_spec=Categorical(2))
    with pytest.raises(UserError, match="discrete actions and the task continuous"):
        check_demonstration(discrete, action_spec=Bounded(-1.0, 1.0, (1,)))
