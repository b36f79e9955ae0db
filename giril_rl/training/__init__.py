"""What recipes compose: a demonstration, reward training, the training loop, scores."""

from giril_rl.moved import forwarding
from giril_rl.policies import load_agent, make_agent
from giril_rl.runs.run import Run
from giril_rl.training.algorithm import Algorithm, make_algorithm
from giril_rl.training.baselines import (
    HeldAction,
    RandomPolicy,
    check_discrete,
    held_action_scores,
)
from giril_rl.training.cloning import clone_behaviour
from giril_rl.training.cloning_beside import CloningTrainer, make_cloning
from giril_rl.training.demonstrations import check_inputs, obtain_demonstration, open_run
from giril_rl.training.experts import check_task, train_expert
from giril_rl.training.fitting import fit_reward
from giril_rl.training.loop import Trained, train_policy
from giril_rl.training.own_visits import VisitTrainer
from giril_rl.training.ppo import PPO, return_scaling
from giril_rl.training.result import finish_run
from giril_rl.training.reward_trainers import (
    AdversarialTrainer,
    RewardTrainer,
    absorbing_value,
    terminal_rate,
)
from giril_rl.training.sac import SAC
from giril_rl.training.scoring import Scores, evaluate, evaluate_both

__all__ = [
    "PPO",
    "SAC",
    "AdversarialTrainer",
    "Algorithm",
    "CloningTrainer",
    "HeldAction",
    "RandomPolicy",
    "RewardTrainer",
    "Run",
    "Scores",
    "Trained",
    "VisitTrainer",
    "absorbing_value",
    "check_discrete",
    "check_inputs",
    "check_task",
    "clone_behaviour",
    "evaluate",
    "evaluate_both",
    "finish_run",
    "fit_reward",
    "held_action_scores",
    "load_agent",
    "make_agent",
    "make_algorithm",
    "make_cloning",
    "obtain_demonstration",
    "open_run",
    "return_scaling",
    "terminal_rate",
    "train_expert",
    "train_policy",
]

__getattr__ = forwarding(__name__)  # Names of version 0.1.
