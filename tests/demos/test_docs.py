"""Every command and snippet of docs/demonstrations.md, from top to bottom in one folder."""

import re
import shlex
from pathlib import Path

import pytest
import torch

from giril_rl.cli import main
from giril_rl.demos import Demonstration, record_demonstration
from giril_rl.envs import AtariGymEnv

PAGE = Path(__file__).parents[2] / "docs" / "demonstrations.md"
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TINY = ["bc.steps=20", "eval.episodes=1", "demo.subsample=10"]


class NoKeys:
    """Nobody plays."""

    def __init__(self, title):
        assert title == "breakout"

    def show(self, frame):
        return frozenset({"right"})

    def close(self):
        pass


def test_all_that_the_page_shows_runs(tmp_path, monkeypatch, capsys):
    pytest.importorskip("ale_py")
    pytest.importorskip("minari")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "minari")
    monkeypatch.setattr("giril_rl.demos.play.Window", NoKeys)
    record_demonstration(
        lambda: AtariGymEnv("breakout"), lambda o: torch.tensor([0]), length=3, seed=0
    ).save("runs/demos/breakout/0a1b2c3d4e5f")
    ran = []
    for kind, text in BLOCK.findall(PAGE.read_text(encoding="utf-8")):
        if kind == "python":
            exec(compile(text, str(PAGE), "exec"), {})
            continue
        for line in text.splitlines():
            command, *words = shlex.split(line, comments=True)
            assert command == "giril"
            code = main([*words, *(TINY if words[0] == "run" else [])])
            assert code == 0, f"{line}\n{capsys.readouterr().err}"
            ran.append(words[1])
    assert {"show", "import", "export", "play", "bc"} == set(ran)
    mine, again = Demonstration.load("demos/mine"), Demonstration.load("demos/again")
    assert (mine.transitions == again.transitions).all()
    assert Demonstration.load("demos/played").card["deterministic"] == "by hand"
    assert Demonstration.load("demos/rollout").has_rewards and not mine.has_rewards
    assert Path("breakout.gif").is_file() and Path("again.npz").is_file()
