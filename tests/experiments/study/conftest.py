"""A recipe that takes no time, for studies of many runs."""

import sys
from pathlib import Path

import pytest

from giril_rl.runs import finished

RECIPE = '''"""Fake: a result after no work; `how` says how to fail."""

import json
import os
import signal
import sys
import time
import types
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from giril_rl.config.schema import RunConfig, knob
from giril_rl.errors import UserError
from giril_rl.runs.identity import config_hash

HOW = ("well", "user", "bug", "once", "killed", "slow", "stubborn")


@dataclass
class Config(RunConfig):
    how: str = knob("well", "how to end", choices=HOW)
    widths: list[int] = knob([4], "a knob that is a list", low=1)


def main(cfg: Config, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    (out / "config.yaml").write_text(yaml.safe_dump({"recipe": "fake", **asdict(cfg)}))
    with open(out / "began", "a") as began:
        began.write("x")
    if cfg.how == "user":
        raise UserError("the demonstration is empty: record a longer one.")
    if cfg.how == "bug":
        raise RuntimeError("boom")
    if cfg.how == "killed" or (cfg.how == "once" and (out / "began").read_text() == "x"):
        os.kill(os.getpid(), signal.SIGKILL)
    if cfg.how in ("slow", "stubborn") and not (out / "saved").exists():
        try:
            (out / "ready").touch()
            time.sleep(60)
        except KeyboardInterrupt:
            (out / "told").touch()
            if cfg.how == "stubborn":
                time.sleep(60)
            (out / "saved").touch()
            raise
    (out / "result.json").write_text(json.dumps({"config_hash": config_hash(cfg)}))
    # What prints the scores imports torch, which takes far longer than the rest.
    light = types.ModuleType("giril_rl.runs.finished")
    light.print_scores = lambda folder: print("scores of", folder)
    sys.modules[light.__name__] = light
'''
SETTINGS = """
defaults:
  - recipe_schema
  - task: inverted_pendulum
  - _self_
steps: ${task.steps}
"""


@pytest.fixture
def study(tmp_path, monkeypatch):
    """Writes a study of the fake recipe into an empty working directory; its file's name."""
    monkeypatch.chdir(tmp_path)
    # The fake recipe puts another module in this one's place; in this process only for one test.
    monkeypatch.setitem(sys.modules, finished.__name__, finished)
    monkeypatch.setattr("giril_rl.experiments.study.execute.PAUSE", 0.01)
    Path("fake.py").write_text(RECIPE)
    Path("fake.yaml").write_text(SETTINGS)

    def write(text):
        Path("mine.yaml").write_text(text)
        return "mine.yaml"

    return write
