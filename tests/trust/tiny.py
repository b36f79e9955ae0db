"""Every recipe at a budget so small that nothing is learned and all its parts are used."""

PPO = {
    "steps": 256,
    "ppo.num_envs": 2,
    "ppo.rollout": 64,
    "ppo.minibatch": 64,
    "ppo.epochs": 1,
    "ppo.hidden": "[16,16]",
    "ppo.checkpoint_every": 128,
    "eval.episodes": 2,
    "logger": "null",
    "task.env_id": "CartPole-v1",
}
DEMO = {"expert.steps": 2000, "demo.length": 40, "demo.subsample": 2}
FIT = {"fit.steps": 20, "fit.log_every": 10}
SMALL = {"reward.hidden": "[16]"}
BULLET = {"task": "inverted_pendulum", "task.env_id": None}
SAC = {
    "algorithm": "sac",
    "sac.num_envs": 2,
    "sac.rollout": 8,
    "sac.batch": 8,
    "sac.hidden": "[16,16]",
    "sac.random_steps": 32,
    "sac.buffer_size": 100,
    "sac.checkpoint_every": 64,
    "sac.log_every": 32,
}
RECIPES = {
    "expert": {**PPO, "stop_early": "false"},
    "giril": {**PPO, **DEMO, **FIT, **SMALL, **BULLET, "reward.beta": 0.7},
    "cdil": {**PPO, **DEMO, **FIT, **SMALL, "logger": "csv"},
    "gail": {**PPO, **DEMO, **SMALL, "reward.penalty": 1},
    "vail": {**PPO, **DEMO, **SMALL, **BULLET},
    "bc": {**PPO, **DEMO, "steps": 0, "bc.steps": 2040, "bc.log_every": 120},
    "control": {**PPO, **DEMO, **FIT, "reward": "noise"},
    "sac": {**PPO, **DEMO, **FIT, **SMALL, **SAC, **BULLET},
}
GAME = {
    **PPO,
    "task": "breakout",
    "task.env_id": None,
    "task.max_episode_steps": 60,
    "steps": 64,
    "ppo.rollout": 8,
    "ppo.minibatch": 16,
    "ppo.hidden": None,
    "ppo.checkpoint_every": 16,
    "eval.episodes": 1,
}
GAMES = {
    "player": {**GAME, "steps": 16, "stop_early": "false"},
    "game": {**GAME, "demo.subsample": 2, "fit.steps": 4, "fit.batch": 4, "fit.log_every": 2},
}
RECIPE_OF = {"game": "giril", "player": "expert", "sac": "red"}


def words(recipe, root, **more):
    """The command of a recipe below ``root``; a double underscore stands for a dot."""
    given = {key.replace("__", "."): value for key, value in more.items()}
    place = {"root": root, "out": f"{root}/{recipe}"}
    knobs = {**{**RECIPES, **GAMES}[recipe], **place, **given}
    command = ["run", RECIPE_OF.get(recipe, recipe)]
    return [*command, *(f"{k}={v}" for k, v in knobs.items() if v is not None)]
