"""What a learner makes of a failure, of a time limit and of a reset that it is not told of."""

import pytest
import torch
from short_runs import Killed, rows
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import Compose

from giril_rl.config.recipes import shipped
from giril_rl.config.schema import PPOConfig, TaskConfig
from giril_rl.envs import make_env
from giril_rl.errors import UserError
from giril_rl.policies.actor_critic import ActorCritic
from giril_rl.policies.making import make_agent
from giril_rl.runs.run import Run
from giril_rl.training.loop import train_policy
from giril_rl.training.ppo import PPO
from giril_rl.training.scoring import evaluate
from giril_rl.transforms import ReturnScaling


def two_steps(*, failed, done, following=None):
    """From state 1 to state 5 and from state 2 to state 4, each paid 1; the value is the state."""
    agent = ActorCritic(1, Bounded(-1, 1, shape=(1, 1)), hidden=(), normalise=False)
    with torch.no_grad():
        agent.critic[-1].weight.fill_(1.0)
    data = agent.acting()(TensorDict({"observation": torch.tensor([[[1.0], [2.0]]])}, [1, 2]))
    flags = {"terminated": [failed, False], "truncated": [done and not failed, False]}
    after = {name: torch.tensor(value).reshape(1, 2, 1) for name, value in flags.items()}
    after["done"] = after["terminated"] | after["truncated"]
    after["observation"] = torch.tensor([[[5.0], [4.0]]])
    after["reward"] = torch.ones(1, 2, 1)
    if following is not None:
        after["following_observation"] = torch.tensor([[[following], [4.0]]])
    data["next"] = TensorDict(after, [1, 2])
    return agent, data


def targets(termination, **kwargs):
    """Values and advantages added up; gamma and lambda are 1/2, so gamma * lambda is 1/4."""
    agent, data = two_steps(**kwargs)
    cfg = PPOConfig(gamma=0.5, lmbda=0.5, minibatch=2, epochs=1)
    PPO(agent, cfg, steps=1, termination=termination).update(data)
    return data["value_target"].flatten().tolist()


# The second step, which nothing ends: 1 + 4 / 2 - 2 = 1 in advantage, 1 + 2 = 3 in target.


def test_nothing_is_worth_anything_after_a_failure():
    # 1 - 1 = 0 in advantage, on top of the value 1.
    assert targets("ends", failed=True, done=True) == [1.0, 3.0]


def test_bootstrap_goes_on_with_the_terminal_observation_and_no_further():
    # 1 + 5 / 2 - 1 = 2.5 in advantage; the second step's 1 / 4 would make it 2.75.
    assert targets("bootstrap", failed=True, done=True) == [3.5, 3.0]
    assert targets("bootstrap", failed=True, done=True) == targets("ends", failed=False, done=True)


def test_without_a_failure_both_are_the_same():
    # 1 + 5 / 2 - 1 + 1 / 4 = 2.75 where the two steps belong together.
    for termination in ("ends", "bootstrap"):
        assert targets(termination, failed=False, done=False) == [3.75, 3.0]
        assert targets(termination, failed=False, done=True) == [3.5, 3.0]


def test_a_hidden_reset_is_worth_what_it_leads_to():
    # The state goes on from 2, not from 5: 1 + 2 / 2 - 1 + 1 / 4 = 1.25 in advantage.
    for termination in ("ends", "bootstrap"):
        found = targets(termination, failed=False, done=False, following=2.0)
        assert found == [2.25, 3.0]


def test_the_batch_keeps_its_flags():
    agent, data = two_steps(failed=True, done=True)
    cfg = PPOConfig(minibatch=2, epochs=1)
    PPO(agent, cfg, steps=1, termination="bootstrap").update(data)
    assert data["next", "terminated"].flatten().tolist() == [True, False]


def test_other_words_are_refused():
    agent, _ = two_steps(failed=True, done=True)
    with pytest.raises(UserError, match=r"^termination=never: choose one of ends, bootstrap\.$"):
        PPO(agent, PPOConfig(), steps=1, termination="never")


# Whole trainings

BATCH = 4 * 32
pytestmark = pytest.mark.filterwarnings("ignore:.*already returned terminated = True")


def train(folder, **task):
    termination = task.pop("termination", "ends")
    stop_after = task.pop("stop_after", None)
    settings = TaskConfig(
        name="cartpole", env_id="CartPole-v1", max_episode_steps=task.pop("limit", 70), **task
    )
    cfg = PPOConfig(
        num_envs=4, rollout=32, minibatch=64, epochs=2, hidden=[16], checkpoint_every=2 * BATCH
    )
    env = make_env(settings, 4, seed=0)
    agent = make_agent(env, cfg, seed=0)

    class Constant(nn.Module):
        batches = 0

        def forward(self, batch):
            Constant.batches += 1
            if Constant.batches == stop_after:
                raise Killed
            return batch.set(("next", "reward"), torch.ones_like(batch["next", "reward"]))

    relabel = Compose(ReturnScaling(0.99))
    with Run.open(folder, {}, recipe="x") as run:
        train_policy(
            env,
            PPO(agent, cfg, steps=4 * BATCH, termination=termination),
            nn.Sequential(Constant(), relabel),
            seed=0,
            run=run,
        )
    env.close()
    return dict(agent.state_dict()), rows(folder)


CASES = {
    "bootstrap": {"termination": "bootstrap"},
    "fixed, reset": {"horizon": "fixed"},
    "fixed, continue": {"horizon": "fixed", "after_failure": "continue"},
}


@pytest.mark.parametrize("case", CASES)
def test_a_run_that_was_killed_ends_bit_for_bit_as_an_undisturbed_one(case, tmp_path):
    expected, rows = train(tmp_path / "whole", **CASES[case])
    with pytest.raises(Killed):
        train(tmp_path / "run", stop_after=4, **CASES[case])
    torch.manual_seed(1234)
    found, again = train(tmp_path / "run", **CASES[case])
    assert all(torch.equal(found[key], expected[key]) for key in expected)
    assert again == rows
    plain, _ = train(tmp_path / "plain")
    assert not all(torch.equal(found[key], plain[key]) for key in plain)


def test_the_training_curve_is_of_the_tasks_own_score(tmp_path):
    """CartPole pays 1 a step, failing after some 20: a horizon of 70 would be a return of 70."""
    for number, case in enumerate(("fixed, reset", "fixed, continue")):
        _, rows = train(tmp_path / str(number), **CASES[case])
        returns = [row["train/return_mean"] for row in rows if "train/return_mean" in row]
        lengths = [row["train/length_mean"] for row in rows if "train/length_mean" in row]
        assert returns == lengths and 9 < max(returns) < 60
        assert sum(row["train/episodes"] for row in rows) == 4  # 128 steps, a horizon of 70


def test_a_score_is_of_the_tasks_own_episodes():
    fixed = TaskConfig(name="cartpole", env_id="CartPole-v1", horizon="fixed")
    own = TaskConfig(name="cartpole", env_id="CartPole-v1")
    agent = make_agent(make_env(own, 1, seed=0), PPOConfig(hidden=[8]), seed=0)
    scores = [
        evaluate(agent, task, episodes=3, seed=0, deterministic=False) for task in (fixed, own)
    ]
    assert scores[0] == scores[1]
    assert scores[0].episode_length_mean < 100


@pytest.mark.parametrize("recipe", shipped(), ids=lambda recipe: recipe.name)
def test_every_recipe_that_trains_a_policy_passes_the_choice_on(recipe):
    text = recipe.path.read_text()
    assert text.count("termination=cfg.termination") == text.count("ppo = PPO(")
