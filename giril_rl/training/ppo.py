"""The one loop that every recipe trains its policy with: PPO on whatever reward it is given."""

from __future__ import annotations

import contextlib
import functools
import time
import warnings
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Concatenate, NamedTuple, ParamSpec

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from giril_rl.config.schema import PPOConfig
from giril_rl.envs import BatchedEnv
from giril_rl.errors import UserError
from giril_rl.graphs import TracedGradients
from giril_rl.policies import PPOAgent, check_actions, collecting
from giril_rl.runs.finite import Finite
from giril_rl.runs.interrupt import Interrupt, Interrupted
from giril_rl.runs.progress import progress
from giril_rl.runs.randomness import Use, restore_rng, rng_state, stream_seed
from giril_rl.runs.restoring import restoring
from giril_rl.training.episodes import EpisodeTracker
from giril_rl.training.threads import made_on_one_thread
from giril_rl.transforms.batch_mean import BatchMeanReward
from giril_rl.transforms.scaling import NonFiniteReward, ReturnScaling

if TYPE_CHECKING:
    from giril_rl.runs.run import Run
    from giril_rl.training.reward_learner import RewardLearner

LEARNER_KEYS = ("action_log_prob", "advantage", "value_target")
"""What PPO's loss reads of a minibatch, besides the networks' inputs and the agent's draws."""
NO_FAILURE = "no_failure"
"""Stands for ``"terminated"`` where a failure is taken for a time limit: False everywhere."""


class Trained(NamedTuple):
    """What a training was.

    Attributes:
        steps: environment steps.
        seconds: wall-clock seconds.
        inexact_resumes: how often it was resumed without its running episodes.
        averaged: whether its rewards were averaged over the environments.
    """

    steps: int
    seconds: float
    inexact_resumes: int = 0
    averaged: bool = False


Rest = ParamSpec("Rest")


def _closing_env(
    train: Callable[Concatenate[BatchedEnv, Rest], Trained],
) -> Callable[Concatenate[BatchedEnv, Rest], Trained]:
    @functools.wraps(train)
    def closing(env: BatchedEnv, *args: Rest.args, **kwargs: Rest.kwargs) -> Trained:
        try:
            return train(env, *args, **kwargs)
        finally:
            if not env.is_closed:  # By the collector.
                env.close()

    return closing


@_closing_env
def train_ppo(
    env: BatchedEnv,
    agent: PPOAgent,
    relabel: nn.Module,
    cfg: PPOConfig,
    *,
    steps: int,
    seed: int,
    run: Run,
    phase: str = "ppo",
    stop_at: float | None = None,
    learn_reward: RewardLearner | None = None,
    termination: str = "ends",
    use: Use = "training",
) -> Trained:
    """Trains ``agent`` in place on the reward that ``relabel`` writes; resumes by itself.

    The environment's own reward is read for the log, before ``relabel`` replaces it, and by
    nothing that reaches the learner. Checkpoints hold everything that the rest of the run depends
    on, the simulators' state included, so that an interrupted run ends with the same weights. Where
    a simulator does not repeat itself, the run goes on from fresh episodes, and says so.

    Args:
        env: the training environments; closed at the end, however that comes.
        agent: policy and value network; where its weights are, batches go and learning happens.
        relabel: a transform or a composition of them, called with each batch ``(num_envs, time)``;
            its ``state_dict`` is checkpointed.
        cfg: settings of PPO.
        steps: environment steps in all, rounded up to whole batches of
            ``cfg.num_envs * cfg.rollout``.
        seed: seeds action sampling and minibatch order.
        run: where metrics and checkpoints go.
        phase: name of the checkpoint and of the metrics.
        stop_at: ends training once the mean true return of the last 20 training episodes reaches
            this. Only an expert, which may see the true reward, is trained with it.
        learn_reward: trains the reward model beside the policy, on each batch before ``relabel``
            uses it; its state is checkpointed.
        termination: "ends" or "bootstrap", see :class:`PPOLearner`.
        use: what the random numbers are for: "training", or "player" for an expert.

    Returns:
        Environment steps, seconds and inexact resumes, those of earlier processes included.

    Raises:
        UserError: if the agent was made for other actions than the environment's.
        Interrupted: after a checkpoint, if the user asked for it with Ctrl-C.
        RunError: if a loss or a weight is no longer finite; the last checkpoint stays.
    """
    check_actions(agent, env)
    steps = cfg.whole_batches(steps)
    relabel.to(agent.device)
    learner = PPOLearner(agent, cfg, total_steps=steps, termination=termination)
    tracker = EpisodeTracker(cfg.num_envs)
    recent: deque[float] = deque(maxlen=20)
    parts = nn.ModuleDict({"agent": agent, "tracker": tracker, "relabel": relabel})
    averaged = any(isinstance(part, BatchMeanReward) for part in relabel.modules())
    taken, inexact, exact = 0, 0, True
    saved = run.load(phase)
    if saved is not None:
        with restoring(run, phase):
            taken = saved["steps"]
            inexact = saved.get("inexact_resumes", 0)  # Not in those of earlier versions.
            recent.extend(saved["recent"])
            if taken >= steps or saved["stopped"]:
                parts.load_state_dict(saved["parts"])
                return Trained(taken, saved["seconds"], inexact, averaged)
            exact = env.restore_simulator(saved["simulator"])
            inexact += not exact
    batch_size = cfg.num_envs * cfg.rollout
    collector = Collector(
        env,
        collecting(agent, compile=cfg.compile),
        frames_per_batch=batch_size,
        total_frames=steps - taken,
        track_traj_ids=False,
        trust_policy=True,
        auto_register_policy_transforms=False,
        # Each batch is made anew, so that it need not be copied before it is handed out.
        use_buffers=False,
        return_same_td=True,
    )
    # Only now, for making a collector may draw random numbers.
    torch.manual_seed(stream_seed(use, seed))
    if saved is not None:
        with restoring(run, phase):
            parts.load_state_dict(saved["parts"])
            learner.optimizer.load_state_dict(saved["optimizer"])
            if learn_reward is not None:
                learn_reward.load_state_dict(saved["reward_learner"])
            restore_rng(saved["rng"])
    if not exact:
        warnings.warn(
            "the simulator did not come back to where it was saved (it does not repeat itself, or "
            f"is another version): this run goes on at {taken:,} steps from fresh episodes, which "
            "result.json counts in inexact_resumes.",
            stacklevel=2,
        )
        forget_episodes(parts)
    run.truncate_metrics(phase, taken)
    next_save = (taken // cfg.checkpoint_every + 1) * cfg.checkpoint_every
    stopped = False
    finite = Finite(run.folder, steps)
    true_return = "?"
    began = time.perf_counter() - (0.0 if saved is None else saved["seconds"])

    with (
        contextlib.ExitStack() as stack,
        Interrupt() as interrupt,
        progress(steps, taken, phase) as bar,
    ):
        stack.callback(collector.shutdown)
        for batch in made_on_one_thread(collector) if env.has_threads else collector:
            started = time.perf_counter()
            returns, lengths = tracker(batch)
            recent.extend(returns.tolist())
            if agent.device.type != "cpu":
                batch = batch.to(agent.device)
            finite.observations(batch, taken + batch_size)
            learned = {} if learn_reward is None else learn_reward.update(batch)
            finite.losses(learned, taken + batch_size)  # Before its reward is used.
            try:
                batch = relabel(batch)
            except NonFiniteReward as error:
                raise finite.error(error.what, taken + batch_size, "data") from error
            losses = learner.learn(batch, taken)
            taken += batch_size
            metrics = {f"{phase}/{k}": v for k, v in losses.items()}
            metrics.update(learned)
            metrics[f"{phase}/update_seconds"] = time.perf_counter() - started
            metrics[f"{phase}/reward_mean"] = batch.get(("next", "reward")).mean().item()
            metrics["train/episodes"] = float(len(returns))
            if len(returns):
                metrics["train/return_mean"] = returns.mean().item()
                metrics["train/length_mean"] = lengths.double().mean().item()
                true_return = f"{metrics['train/return_mean']:,.1f}"
            bar.update(batch_size, true_return=true_return)
            run.log(taken, metrics, phase=phase)
            finite.losses(losses, taken, batch.select(("next", "reward")))
            if stop_at is not None and len(recent) == recent.maxlen:
                stopped = sum(recent) / len(recent) >= stop_at
            asked = interrupt.requested
            if taken >= next_save or taken >= steps or stopped or asked:
                next_save += cfg.checkpoint_every
                for part in (agent, relabel):  # Not the tracker: the true reward may be anything.
                    finite.weights(part, taken)
                state = {
                    "steps": taken,
                    "seconds": time.perf_counter() - began,
                    "inexact_resumes": inexact,
                    "stopped": stopped,
                    "recent": list(recent),
                    "parts": dict(parts.state_dict()),
                    "optimizer": learner.optimizer.state_dict(),
                    "simulator": env.simulator_state(),
                    "rng": rng_state(agent.device),
                    "reward_learner": None if learn_reward is None else learn_reward.state_dict(),
                }
                run.save(phase, state)
            if stopped or asked:
                break
    if interrupt.requested:  # At the end as well, for the run may have more to do.
        whose = "player" if run.recipe == "expert" else "policy"
        raise Interrupted.at(taken, steps, part=f"the {whose}'s training", most=stop_at is not None)
    return Trained(taken, time.perf_counter() - began, inexact, averaged)


def forget_episodes(parts: nn.Module) -> None:
    """Clears the sums over running episodes, whose rest is lost."""
    for part in parts.modules():
        if isinstance(part, EpisodeTracker):
            part.running_return.zero_()
            part.running_length.zero_()
        elif isinstance(part, ReturnScaling) and part.reset_rule == "done":
            part.running_return.zero_()


class PPOLearner:
    """One PPO update: advantages, then epochs of minibatches, on TorchRL's GAE and ClipPPOLoss.

    Args:
        agent: policy and value network.
        cfg: settings of PPO.
        total_steps: environment steps of the whole training, for a decreasing step size.
        termination: "ends" (nothing is worth anything after a failure) or "bootstrap" (a failure is
            taken for a time limit: the value of the terminal observation continues). Either way
            ``done`` ends the episode, beyond which advantages do not look.
    """

    def __init__(
        self, agent: PPOAgent, cfg: PPOConfig, *, total_steps: int, termination: str = "ends"
    ) -> None:
        if termination not in ("ends", "bootstrap"):
            raise UserError(f"termination={termination}: choose one of ends, bootstrap.")
        self.bootstraps_failure = termination == "bootstrap"
        self.agent = agent
        self.cfg = cfg
        self.total_steps = total_steps
        # Standardised over the whole batch, not per minibatch: a minibatch without any event would
        # have its noise blown up to unit variance, and the policy would follow it.
        self.advantage = GAE(
            gamma=cfg.gamma,
            lmbda=cfg.lmbda,
            value_network=agent.value_network(),
            average_gae=True,
        )
        if self.bootstraps_failure:
            self.advantage.set_keys(terminated=NO_FAILURE)
        loss = RecordableClipPPOLoss(
            agent.actor_for_loss(),
            agent.critic_for_loss(),
            clip_epsilon=cfg.clip,
            clip_value=cfg.clip if cfg.clip_value else None,
            entropy_bonus=cfg.entropy_coef > 0,
            entropy_coeff=cfg.entropy_coef,
            critic_coeff=cfg.value_coef,
            loss_critic_type="l2",
            normalize_advantage=False,
            log_explained_variance=False,
            functional=False,
        )
        # The clipped value loss compares with the value as it was.
        self.keys = (
            *agent.input_keys,
            agent.drawn_key,
            *LEARNER_KEYS,
            *["state_value"] * cfg.clip_value,
        )
        self.gradients = TracedGradients(
            loss,
            keys=self.keys,
            log=("kl_approx", "clip_fraction"),
            max_grad_norm=cfg.max_grad_norm,
            compile=cfg.compile,
        )
        # The implementation that updates all parameters in one call.
        self.optimizer = torch.optim.Adam(
            self.gradients.parameters, lr=cfg.lr, eps=1e-5, fused=True
        )

    def learn(self, batch: TensorDictBase, taken: int) -> dict[str, float]:
        """Updates the agent on a relabelled batch ``(num_envs, time)``.

        Args:
            batch: what the acting policy collected, with the reward to learn from.
            taken: environment steps before this batch.

        Returns:
            Means over the update's last epoch.
        """
        cfg = self.cfg
        if cfg.anneal_lr:
            for group in self.optimizer.param_groups:
                group["lr"] = cfg.lr * (1 - taken / self.total_steps)
        with torch.no_grad():
            # Where the environment was reset unnoticed, the value is that of where it goes on.
            following = batch.get(("next", "following_observation"), None)
            if following is None:
                following = batch.get(("next", "observation"))
            self.agent.prepare(batch, following)
            if self.bootstraps_failure:
                failed = batch.get(("next", "terminated"))
                batch.set(("next", NO_FAILURE), torch.zeros_like(failed))
            self.advantage(batch)
        flat = [batch.get(key).flatten(0, 1) for key in self.keys]
        for _ in range(cfg.epochs):
            logs: list[dict[str, Tensor]] = []
            order = torch.randperm(batch.numel()).to(self.agent.device)
            for minibatch in zip(*(x[order].split(cfg.minibatch) for x in flat), strict=True):
                logs.append(self.gradients.step(minibatch))
                self.optimizer.step()
        self.agent.update_normaliser(batch.get("observation"))
        return {k: torch.stack([log[k] for log in logs]).mean().item() for k in logs[0]}


class RecordableClipPPOLoss(ClipPPOLoss):
    """:class:`torchrl.objectives.ClipPPOLoss` that looks at no tensor's value on its way.

    TorchRL looks whether the entropy is finite and estimates it from samples where it is not, which
    a recorded graph cannot decide anew at each call; these distributions know their entropy. And it
    asks the tensor ``clip_value`` whether it is zero, for which a GPU would be waited for.
    """

    clip_value: float | None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if "clip_value" in self._buffers:
            bound = self.get_buffer("clip_value").item()
            del self.clip_value
            self.clip_value = bound

    def _get_entropy(self, dist: Any, adv_shape: torch.Size) -> Tensor:
        return dist.entropy().unsqueeze(-1)
