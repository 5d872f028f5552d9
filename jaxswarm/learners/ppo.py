"""Proximal policy optimization with clipping (Schulman et al., 2017)."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.learners import on_policy
from jaxswarm.learners.on_policy import LearnerState, Minibatch, OnPolicy, Params
from jaxswarm.rollout import Trajectory
from jaxswarm.types import Key, Metrics, pytree


@pytree
class PPO(OnPolicy):
    """Hyper-parameters of PPO, and the learner."""

    clip_range: float = 0.2

    def __post_init__(self) -> None:
        on_policy.check(self)
        require(self, checks.POSITIVE, "clip_range")

    def init(self, params: Params) -> LearnerState:
        """State before the first update."""
        return LearnerState(params, on_policy.adam(self).init(params))

    def update(
        self, key: Key, state: LearnerState, network: Any, task: Any, trajectory: Trajectory
    ) -> tuple[LearnerState, Metrics]:
        """Learns from one trajectory, all epochs."""

        def loss(params: Params, batch: Minibatch) -> tuple[Array, Metrics]:
            return self.loss(network, params, batch)

        return on_policy.update(self, loss, key, state, network, task, trajectory)

    def loss(self, network: Any, params: Params, batch: Minibatch) -> tuple[Float[Array, ""], Metrics]:
        """Clipped surrogate, squared value error and entropy bonus of a minibatch; advantages are normalized in it."""
        policy, value = network.apply(params, batch.obs)
        mean = partial(on_policy.mean, mask=batch.obs.mask)
        log_ratio = policy.log_prob(batch.action) - batch.log_prob
        ratio = jnp.exp(log_ratio)
        advantage = on_policy.standardized(batch.advantage, batch.obs.mask)
        clipped = jnp.clip(ratio, 1.0 - self.clip_range, 1.0 + self.clip_range)
        policy_loss = -mean(jnp.minimum(ratio * advantage, clipped * advantage))
        value_loss = on_policy.squared_error(value, batch.target, batch.obs.mask)
        entropy = mean(policy.entropy())
        metrics = {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "entropy": entropy,
            "approx_kl": mean(ratio - 1.0 - log_ratio),
            "clip_fraction": mean((jnp.abs(ratio - 1.0) > self.clip_range).astype(jnp.float32)),
            "policy_std": mean(policy.stddev().mean(-1)),
        }
        loss = policy_loss + self.value_coefficient * value_loss - self.entropy_coefficient * entropy
        return loss, jax.lax.stop_gradient(metrics)
