"""Learners: how a policy gets better from trajectories."""

from jaxswarm.learners.ppo import PPO

LEARNERS = {"ppo": PPO}
