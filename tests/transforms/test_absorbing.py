import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from giril_rl.envs import GymVectorEnv
from giril_rl.errors import UserError
from giril_rl.transforms import AbsorbingReward


def batch():
    """A failure, a time limit, and a step in between, in two environments."""
    terminated = torch.tensor([[1, 0, 0], [0, 0, 1]], dtype=torch.bool).unsqueeze(-1)
    truncated = torch.tensor([[0, 1, 0], [0, 0, 0]], dtype=torch.bool).unsqueeze(-1)
    reward = torch.arange(6.0).reshape(2, 3, 1)
    flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    return TensorDict({"next": {"reward": reward, **flags}}, [2, 3])


@pytest.mark.parametrize("value", [0.7, -2.0])
def test_a_failure_is_worth_the_sum_of_all_that_follows(value):
    gamma, data = 0.9, batch()
    after = sum(gamma**t * value for t in range(1, 500))
    out = AbsorbingReward(lambda: torch.tensor(value), gamma)(data)
    expected = [after, 1.0, 2.0, 3.0, 4.0, 5.0 + after]
    torch.testing.assert_close(out["next", "reward"].flatten(), torch.tensor(expected))
    assert data["next", "reward"].flatten().tolist() == list(range(6))


def test_it_is_read_anew_at_each_call():
    values = iter((1.0, 2.0))
    transform = AbsorbingReward(lambda: torch.tensor(next(values)), 0.5)
    first, second = (transform(batch())["next", "reward"][0, 0].item() for _ in range(2))
    assert (first, second) == (1.0, 2.0)


def test_an_environment_gives_the_batchs_numbers(step_counter):
    def env():
        return GymVectorEnv(step_counter, 3, seed=0, max_episode_steps=5)

    transform = AbsorbingReward(lambda: torch.tensor(-1.0), 0.9)
    torch.manual_seed(0)
    plain = env().rollout(12, break_when_any_done=False)
    torch.manual_seed(0)
    inside = TransformedEnv(env(), AbsorbingReward(lambda: torch.tensor(-1.0), 0.9))
    found = inside.rollout(12, break_when_any_done=False)
    torch.testing.assert_close(found["next", "reward"], transform(plain)["next", "reward"])
    ends = plain["next", "terminated"]
    assert 0 < ends.sum() < plain["next", "done"].sum()
    check_env_specs(inside)


def test_refusals():
    for gamma in (1.0, -0.1):
        with pytest.raises(UserError, match="absorbing state's rewards have a finite sum"):
            AbsorbingReward(lambda: torch.tensor(1.0), gamma)
    transform = AbsorbingReward(lambda: torch.tensor(1.0), 0.9)
    with pytest.raises(UserError, match="terminated"):
        transform(batch().exclude(("next", "terminated")))
