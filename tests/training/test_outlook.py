"""What a run says of its length before it begins."""

import pytest

from giril_rl.config.schema import (
    DemoConfig,
    ExpertConfig,
    ExpertRunConfig,
    FitConfig,
    RunConfig,
    TaskConfig,
)
from giril_rl.methods import ControlRunConfig
from giril_rl.training import open_run, train_expert
from giril_rl.training.outlook import announce, outlook

BREAKOUT = TaskConfig(name="breakout", env_id="ALE/Breakout-v5", expert_steps=9_000_000)
POLE = TaskConfig(name="pole", env_id="CartPole-v1", expert_steps=180_000)


def test_a_player_is_announced_only_where_one_is_trained():
    cfg = RunConfig(task=BREAKOUT, steps=36_000_000)
    cfg.fit = FitConfig(steps=43_200)  # 43,200 / 12 a second is an hour.
    rest = {"reward model: 43,200 steps": 3_600, "policy: 36,000,000 steps": 72_000}
    found = outlook(cfg, ExpertConfig(), DemoConfig(), has_player=False)
    assert found == {"player: at most 9,000,000 steps": 18_000, **rest}
    for expert, demo, has_player in (
        (ExpertConfig(), DemoConfig(), True),
        (ExpertConfig(path="player"), DemoConfig(), False),
        (ExpertConfig(), DemoConfig(path="shipped"), False),
    ):
        assert outlook(cfg, expert, demo, has_player=has_player) == rest


def test_what_is_short_begins_without_a_word(capsys):
    announce(RunConfig(task=POLE, steps=180_000), ExpertConfig(), DemoConfig(), has_player=False)
    assert capsys.readouterr().err == ""
    announce(RunConfig(task=POLE, steps=720_000), ExpertConfig(), DemoConfig(), has_player=False)
    assert "player: at most 180,000 steps, about 30 s; policy: 720,000 steps, about 2 min" in (
        capsys.readouterr().err
    )


def test_runs_that_learn_from_nobody_tell_it_too(tmp_path, capsys, monkeypatch):
    """An expert, and a control without a demonstration, before anything is made."""

    class Began(Exception):
        pass

    def begin(*_, **__):
        raise Began

    monkeypatch.setattr("giril_rl.training.experts.make_env", begin)
    cfg = ExpertRunConfig(task=POLE, steps=720_000)
    with pytest.raises(Began):
        train_expert(cfg, tmp_path / "expert")
    assert "policy: 720,000 steps, about 2 min" in capsys.readouterr().err
    cfg = ControlRunConfig(task=POLE, steps=720_000, reward="constant")
    with open_run(cfg, tmp_path / "control", recipe="control"):
        assert "policy: 720,000 steps, about 2 min" in capsys.readouterr().err
