"""A finished run's reward model and the demonstration that it was fitted to; nothing is made."""

from __future__ import annotations

from pathlib import Path

from tensordict.nn import TensorDictModuleBase

from giril_rl.configs import DemoConfig, ExpertConfig, FitConfig, GenerativeConfig, RunConfig
from giril_rl.demos import Demonstration
from giril_rl.envs import make_env
from giril_rl.errors import UserError
from giril_rl.naming import config_hash
from giril_rl.rewards import AffineReward, GenerativeReward
from giril_rl.training.checkpoint import load_state
from giril_rl.training.expert import demonstration_place, expert_settings
from giril_rl.training.finished import read_config, read_part, read_result, read_settings
from giril_rl.training.metrics import read_metrics
from giril_rl.training.reward_models import generative_reward

FIT_FILE = "fit.safetensors"
UNTRAINED, _NEGATED, _CENTRED = (
    f"control:{name}_giril" for name in ("untrained", "negated", "centred")
)
_SECTION = {"giril": "reward", UNTRAINED: "giril", _NEGATED: "giril", _CENTRED: "giril"}
GENERATIVE = frozenset(_SECTION)
"""Methods, as results name them, whose reward is the error of a generative model."""


def load_reward(folder: Path) -> tuple[GenerativeReward, TensorDictModuleBase]:
    """The generative model of a finished run, and its reward before any scaling.

    The reward is the model itself, or for some controls the model negated or without its mean. Both
    are on the CPU and in eval mode. For frames only: a scaler of vectors is left unfitted.

    Args:
        folder: the folder of a run of one of the methods :data:`GENERATIVE`.

    Raises:
        UserError: if the run has another method or the weights are missing, damaged or another's.
    """
    method = str(read_result(folder)["method"])
    if method not in GENERATIVE:
        raise UserError(f"{folder} has no generative reward: its method is {method}.")
    config = read_config(folder)
    task, _, _ = read_settings(folder)
    settings = read_part(folder, config, _SECTION[method], GenerativeConfig)
    fit = read_part(folder, config, "fit", FitConfig)
    env = make_env(task, 1, seed=0)
    seed = config["seed"] if settings.seed is None else settings.seed
    model = generative_reward(settings, env, None, seed=seed)
    env.close()
    if method != UNTRAINED and fit.steps:
        _restore(model, folder / FIT_FILE)
    model.eval()
    if method == _NEGATED:
        return model, AffineReward(model, scale=-1.0)
    if method == _CENTRED:
        return model, AffineReward(model, shift=-_mean(folder))
    return model, model


def _restore(model: GenerativeReward, path: Path) -> None:
    if not path.exists():
        raise UserError(f"{path} does not exist, which has the reward model's weights.")
    state = load_state(path).get("loss")
    own = "reward."
    found = state.items() if isinstance(state, dict) else ()
    weights = {key.removeprefix(own): value for key, value in found if key.startswith(own)}
    try:
        model.load_state_dict(weights)
    except RuntimeError:
        raise UserError(
            f"{path} does not fit the run's own settings: it belongs to another run."
        ) from None


def _mean(folder: Path) -> float:
    for row in read_metrics(folder / "metrics.jsonl"):
        if "moments/mean" in row:
            return float(row["moments/mean"])
    raise UserError(f"{folder}/metrics.jsonl lacks moments/mean, which the reward is centred by.")


def find_demonstration(folder: Path) -> Demonstration | None:
    """The demonstration of a finished run where it is still there; none is recorded for want of it.

    It is looked for in the run's ``root`` and, for runs that were moved or copied since, in each
    folder above the run's.

    Args:
        folder: the run's folder.

    Returns:
        The demonstration, or None if it is gone, or is another one than at the time of the run.

    Raises:
        UserError: if it is there and damaged.
    """
    config, result = read_config(folder), read_result(folder)
    demo = read_part(folder, config, "demo", DemoConfig)
    for place in _places(folder, demo):
        if (place / "card.json").is_file():
            found = Demonstration.load(place)
            return found if len(found) == result.get("demo_transitions") else None
    return None


def _places(folder: Path, demo: DemoConfig) -> list[Path]:
    if demo.path is not None:
        return [Path(demo.path)]
    config = read_config(folder)
    task, _, _ = read_settings(folder)
    expert = read_part(folder, config, "expert", ExpertConfig)
    if expert.path is None:
        made_by = config_hash(expert_settings(RunConfig(task=task), expert))
    elif (Path(expert.path) / "result.json").is_file():
        made_by = str(read_result(Path(expert.path))["config_hash"])
    else:
        return []
    roots = [Path(config.get("root", "runs")), *folder.resolve().parents]
    return [root / demonstration_place(task, demo, made_by) for root in roots]
