"""The page's snippets, one after another as a reader would run them, and the tutorial."""

import ast
import importlib.util
import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

DOCS = Path(__file__).parents[1] / "docs"
TUTORIAL = DOCS / "tutorials" / "ppo_with_giril.py"


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_every_snippet_of_the_page_runs():
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "reuse.md").read_text(), re.DOTALL)
    assert len(blocks) == 7
    names: dict[str, object] = {"__name__": "reuse"}
    for block in blocks:
        exec(compile(block, str(DOCS / "reuse.md"), "exec"), names)
    assert (names["batch"]["next", "reward"] != names["batch"]["next", "extrinsic_reward"]).all()
    policy = TensorDictModule(nn.Linear(3, 1), ["observation"], ["action"])
    names["collect"](policy)


def load():
    spec = importlib.util.spec_from_file_location("ppo_with_giril", TUTORIAL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tutorial_runs_and_the_true_reward_stays_unseen():
    tutorial = load()
    tiny = {"frames": 128, "batch": 64, "epochs": 1, "fit_steps": 5}
    history = tutorial.train(**tiny)
    assert len(history) == 2 and all(value < 0 for value in history)
    demo = TensorDict(
        {
            "observation": torch.randn(50, 3),
            "action": torch.rand(50, 1),
            "next": {"observation": torch.randn(50, 3)},
        },
        [50],
    )
    assert len(tutorial.train(demonstration=demo, **tiny)) == 2


def test_without_the_marked_lines_the_tutorial_is_plain_torchrl():
    lines = TUTORIAL.read_text().splitlines()
    marked = [line for line in lines if line.endswith("# GIRIL")]
    assert len(marked) <= 6
    rest = "\n".join(line for line in lines if line not in marked)
    code = ast.unparse([n for n in ast.parse(rest).body if not isinstance(n, ast.Expr)])
    for name in ("giril_rl", "reward.", "IntrinsicReward", "fit("):
        assert name not in code
    spec = importlib.util.spec_from_loader("plain", None)
    plain = importlib.util.module_from_spec(spec)
    exec(compile(rest, "plain", "exec"), plain.__dict__)
    assert len(plain.train(frames=64, batch=64, epochs=1)) == 1
