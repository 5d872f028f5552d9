"""Proximal policy optimization with a clipped surrogate (Schulman et al., 2017)."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.learners import on_policy
from jaxswarm.learners.on_policy import LearnerState, Minibatch, OnPolicy, Params
from jaxswarm.networks import Network
from jaxswarm.rollout import Trajectory
from jaxswarm.types import Key, Metrics, pytree


@pytree
class PPO(OnPolicy):
    """Proximal policy optimization with its hyperparameters; `OnPolicy` documents the inherited ones.

    Attributes:
        clip_range: The probability ratio is clipped to the range 1 - clip_range ... 1 + clip_range (clip_range > 0).
    """

    clip_range: float = 0.2

    def __post_init__(self) -> None:
        on_policy.check(self)
        require(self, checks.POSITIVE, "clip_range")

    def init(self, params: Params) -> LearnerState:
        """Return the state before the first update."""
        return LearnerState(params, on_policy.adam(self).init(params))

    def update(
        self, key: Key, state: LearnerState, network: Network, task: Any, trajectory: Trajectory
    ) -> tuple[LearnerState, Metrics]:
        """Update the parameters from one trajectory, in all epochs."""

        def loss(params: Params, batch: Minibatch) -> tuple[Array, Metrics]:
            return self.loss(network, params, batch)

        return on_policy.update(self, loss, key, state, network, task, trajectory)

    def loss(self, network: Network, params: Params, batch: Minibatch) -> tuple[Float[Array, ""], Metrics]:
        """Return the clipped surrogate plus value loss minus entropy bonus, and metrics.

        The advantages are standardized within the minibatch.
        """
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
