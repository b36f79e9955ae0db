"""Agents (a policy with the networks trained beside it): making, saving, loading, acting."""

from giril_rl.policies.actor_critic import NORMALISED, ActorCritic, PPOAgent
from giril_rl.policies.agent import ActingPolicy, Agent, RecordedActing, collecting
from giril_rl.policies.making import (
    POLICY,
    agent_for,
    check_actions,
    fits,
    load_agent,
    load_agent_from,
    make_agent,
    make_sac_agent,
)
from giril_rl.policies.pixel_actor_critic import PixelActorCritic
from giril_rl.policies.soft_actor_critic import SACAgent

__all__ = [
    "NORMALISED",
    "POLICY",
    "ActingPolicy",
    "ActorCritic",
    "Agent",
    "PPOAgent",
    "PixelActorCritic",
    "RecordedActing",
    "SACAgent",
    "agent_for",
    "check_actions",
    "collecting",
    "fits",
    "load_agent",
    "load_agent_from",
    "make_agent",
    "make_sac_agent",
]
