"""Learners, which improve a policy from trajectories: PPO and trust region layers (TRL)."""

from jaxswarm.learners.ppo import PPO
from jaxswarm.learners.projections import PROJECTIONS
from jaxswarm.learners.trl import TRL
from jaxswarm.registry import Registry

LEARNERS = Registry("learner", {"ppo": PPO, "trl": TRL})

__all__ = ["LEARNERS", "PPO", "PROJECTIONS", "TRL"]
