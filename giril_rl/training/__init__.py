"""The loops that recipes share: fit a reward, PPO on a reward, score, keep and resume."""

from giril_rl.moved import forwarding
from giril_rl.policies.agent import load_agent, make_agent
from giril_rl.runs.run import Run
from giril_rl.training.adversarial import AdversarialLearner
from giril_rl.training.clone import clone_behaviour
from giril_rl.training.evaluate import Scores, evaluate, evaluate_both
from giril_rl.training.expert import check_inputs, check_task, obtain_demonstration, train_expert
from giril_rl.training.fit import fit_reward
from giril_rl.training.held_action import HeldAction, check_discrete, held_action_scores
from giril_rl.training.ppo import PPOLearner, Trained, train_ppo
from giril_rl.training.random_policy import RandomPolicy
from giril_rl.training.result import finish_run
from giril_rl.training.reward_learner import RewardLearner
from giril_rl.training.scaling import return_scaling

__all__ = [
    "AdversarialLearner",
    "HeldAction",
    "PPOLearner",
    "RandomPolicy",
    "RewardLearner",
    "Run",
    "Scores",
    "Trained",
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
    "obtain_demonstration",
    "return_scaling",
    "train_expert",
    "train_ppo",
]

__getattr__ = forwarding(__name__)  # Names of version 0.1.
