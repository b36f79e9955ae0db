"""A recipe that was copied from version 0.1 still runs, and is told the new names."""

import subprocess
import sys
from pathlib import Path

from giril_rl.moved import MOVED, NAMES

RECIPE = '''"""Old: the imports of a copied recipe of version 0.1."""

from dataclasses import dataclass
from pathlib import Path

from giril_rl.configs import GenerativeConfig, RunConfig, knob
from giril_rl.training import generative_reward


@dataclass
class Config(RunConfig):
    width: int = knob(4, "a number")


def main(cfg: Config, out: Path) -> None:
    print(generative_reward.__name__, GenerativeConfig.__name__)
'''


def test_a_copied_recipe_of_before_runs_with_warnings(tmp_path):
    Path(tmp_path, "old.py").write_text(RECIPE)
    text = "defaults: [recipe_schema, {task: inverted_pendulum}, {profile: released}, _self_]\n"
    Path(tmp_path, "old.yaml").write_text(text + "steps: 20000\n")
    command = [sys.executable, "-m", "giril_rl", "run", "old.py"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "generative_reward GenerativeConfig\n"), (
        done.stderr
    )
    assert "giril_rl.configs is now giril_rl.config.schema; " in done.stderr
    assert "giril_rl.training.generative_reward is now giril_rl.rewards." in done.stderr


def test_every_old_name_is_found():
    code = "\n".join(
        [
            *(f"import giril_rl.{old}" for old in MOVED),
            *(
                f"from giril_rl.{old.rpartition('.')[0]} import {old.rpartition('.')[2]}"
                for old in NAMES
            ),
        ]
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)
