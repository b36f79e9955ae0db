"""Runs that learn from less of a demonstration, and what is refused before anything is trained."""

import json
from dataclasses import dataclass, field, replace

import gymnasium
import pytest

from giril_rl.cli.command_line import main
from giril_rl.config.compose import resolved
from giril_rl.config.recipes import config_class, find
from giril_rl.config.schema import DemoConfig, RewardRunConfig, TaskConfig
from giril_rl.config.validation import validate
from giril_rl.demos import Demonstration, record_demonstration
from giril_rl.errors import UserError
from giril_rl.rewards import AdversarialConfig
from giril_rl.runs.identity import config_hash
from giril_rl.training import check_inputs, obtain_demonstration
from giril_rl.training.algorithm import check_replay
from giril_rl.training.demonstrations import demonstration_place, find_demonstration

CARTPOLE = TaskConfig("cartpole", "CartPole-v1")
TINY = ["ppo.num_envs=2", "ppo.rollout=32", "ppo.minibatch=32", "ppo.epochs=1", "ppo.hidden=[8]"]
TINY += ["eval.episodes=1", "logger=null", "steps=64", "task.env_id=CartPole-v1"]
FIT = ["fit.steps=5", "fit.log_every=5"]


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """Three whole episodes, the same without actions, and the folder that both are in."""
    folder = tmp_path_factory.mktemp("given")
    demo = record_demonstration(
        lambda: gymnasium.make("CartPole-v1"),
        lambda o: (o[:, 2] > 0).long(),
        episodes=3,
        seed=0,
        expert={"return_mean": 40.0, "seed": 3},
    )
    demo.save(folder / "whole")
    demo.without_actions().save(folder / "states")
    return folder


def words(recipe, given, name, out, *more):
    found = [*TINY, f"demo.path={given / name}", f"out={out}", *more]
    if recipe in ("giril", "cdil", "red"):
        found += FIT
    return ["run", recipe, *(word for word in found if recipe != "bc" or word != "steps=64")]


@dataclass
class Config(RewardRunConfig):
    reward: AdversarialConfig = field(default_factory=AdversarialConfig)


def config(given, name="whole", **demo):
    return Config(
        task=CARTPOLE, steps=64, demo=DemoConfig(path=str(given / name), subsample=1, **demo)
    )


# Without actions


@pytest.mark.parametrize("recipe", ["giril", "cdil", "gail", "vail", "red"])
def test_a_reward_of_states_is_learned_from_states(recipe, given, tmp_path):
    more = ["reward.use_actions=false", *(["reward.features=none"] * (recipe == "cdil"))]
    assert main(words(recipe, given, "states", tmp_path / "run", *more)) == 0
    result = json.loads((tmp_path / "run/result.json").read_text())
    states = Demonstration.load(given / "states")
    assert result["demo_id"] == states.demo_id and result["demo_transitions"] == len(states)
    card = json.loads((tmp_path / "run/reward/card.json").read_text())
    assert card["made_by"]["arguments"]["use_actions"] is False


@pytest.mark.parametrize(
    ("recipe", "more", "told"),
    [
        ("gail", [], "reward.use_actions=true reads: set reward.use_actions=false."),
        ("cdil", ["reward.use_actions=false"], "set reward.features=none"),
        ("bc", [], "which this recipe learns from: give one that has them"),
        ("control", ["reward=noise"], "giril.use_actions=true reads: set giril.use_actions=false."),
        ("control", ["reward=untrained_icm"], "set icm.use_actions=false."),
    ],
)
def test_what_reads_actions_refuses_states_before_anything_is_made(
    recipe, more, told, given, tmp_path, capsys
):
    assert main(words(recipe, given, "states", tmp_path / "run", *more)) == 2
    printed = capsys.readouterr().err
    assert told in printed and printed.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_the_copy_needs_no_actions(given, tmp_path):
    assert main(words("control", given, "states", tmp_path / "run", "reward=copy")) == 0


@pytest.mark.parametrize("chosen", ["seed", "half"])
def test_states_are_not_put_into_a_replay(chosen, given):
    cfg = config(given, "states")
    cfg.reward.use_actions = False
    check_inputs(cfg)
    cfg.algorithm, cfg.sac.demonstration = "sac", chosen
    told = f"has no actions, which sac.demonstration={chosen} puts into the replay: set sac.demo"
    with pytest.raises(UserError, match=told):
        check_inputs(cfg)
    with pytest.raises(UserError, match=told):
        check_replay(cfg, Demonstration.load(given / "states"))
    cfg.sac.demonstration = "none"
    check_inputs(cfg)


# Less of it


def test_the_run_uses_and_names_the_part(given, tmp_path):
    more = ["demo.episodes=2", "demo.first=12", "demo.subsample=5", "reward.hidden=[8]"]
    assert main(words("gail", given, "whole", tmp_path / "run", *more)) == 0
    result = json.loads((tmp_path / "run/result.json").read_text())
    whole = Demonstration.load(given / "whole")
    assert (result["demo_transitions"], result["demo_pairs"]) == (12, 3)
    assert result["demo_id"] != whole.demo_id
    assert result["demo_return_mean"] == whole.returns[:2].mean().item()
    assert result["expert_return_mean"] == 40.0
    # A report finds the same part again.
    found = find_demonstration(tmp_path / "run", given.parent)
    assert found.demo_id == result["demo_id"]


def test_episodes_of_a_given_demonstration(given):
    whole = Demonstration.load(given / "whole")
    demo, _ = obtain_demonstration(config(given, episodes=2))
    assert demo.lengths.tolist() == whole.lengths[:2].tolist()
    cfg = config(given, length=None, episodes=4)
    validate(cfg)
    with pytest.raises(UserError, match=r"^demo\.episodes=4: .* has 3 whole episodes"):
        check_inputs(cfg)
    with pytest.raises(UserError, match=r"^demo\.first=5000: the demonstration has \d+ trans"):
        check_inputs(config(given, first=5000))


def test_more_than_will_be_recorded_is_refused():
    demo = DemoConfig(length=100, first=200)
    with pytest.raises(UserError, match=r"^first=200 is more than length=100"):
        validate(demo)
    validate(replace(demo, path="somewhere"))
    with pytest.raises(UserError, match=r"^subsample=20 leaves nothing of first=10"):
        validate(DemoConfig(first=10))


def test_a_part_is_of_the_same_recording_and_another_run():
    cfg = Config(task=CARTPOLE, steps=64)
    part = replace(cfg, demo=DemoConfig(first=62))
    places = {demonstration_place(c, c.demo, "0123456789ab") for c in (cfg, part)}
    assert len(places) == 1
    assert config_hash(cfg) != config_hash(part)


def test_a_shipped_demonstration_stays_the_tasks_own():
    recipe = find("gail")
    for word in ("demo.first=62", "demo.subsample=1"):
        cfg, *_ = resolved(recipe, config_class(recipe), ["task=inverted_pendulum", word])
        assert cfg.demo.path == "shipped"
    cfg.demo.first = 62
    demo, _ = obtain_demonstration(cfg)
    assert len(demo) == 62 and demo.mean_return() == 1000.0


def test_a_replay_buffer_holds_the_demonstration_before_anything_is_trained(given):
    whole = Demonstration.load(given / "whole")
    cfg = config(given)
    cfg.algorithm, cfg.sac.buffer_size = "sac", len(whole)
    check_inputs(cfg)
    cfg.sac.buffer_size -= 1
    with pytest.raises(UserError, match=rf"^sac\.buffer_size=\d+ is less .* {len(whole)} tr"):
        check_inputs(cfg)
    cfg.demo.first = len(whole) - 1  # What is not used needs no room.
    check_inputs(cfg)
    cfg.demo.first, cfg.demo.subsample = None, 2
    check_inputs(cfg)
    cfg.demo.subsample = 1
    cfg.demo.first, cfg.sac.demonstration = None, "none"
    check_inputs(cfg)


def test_off_policy_a_reward_of_states_is_learned_from_states(given, tmp_path):
    off = ["algorithm=sac", "sac.demonstration=none", "sac.random_steps=16", "sac.hidden=[8]"]
    off += ["reward.use_actions=false", "demo.subsample=1"]
    kept = [w for w in words("red", given, "states", tmp_path / "run", *off) if "ppo." not in w]
    assert main(kept) == 0
    assert json.loads((tmp_path / "run/result.json").read_text())["env_steps"] == 64


# Of another task


def test_another_environment_of_the_same_spaces_is_refused(given):
    """CartPole's observations and actions, under another id."""
    gymnasium.register("OtherPole-v0", "gymnasium.envs.classic_control.cartpole:CartPoleEnv")
    cfg = config(given)
    sentence = r"is of CartPole-v1 and not of OtherPole-v0: use one of .* env_id out of its card"
    with pytest.raises(UserError, match=sentence):
        check_inputs(replace(cfg, task=TaskConfig("other", "OtherPole-v0", 200)))
    # The name of the task, its horizon and its environment's version are no other environment.
    check_inputs(replace(cfg, task=TaskConfig("renamed", "CartPole-v0", horizon="fixed")))
