"""Proximal policy optimisation with clipping (Schulman et al., 2017)."""

from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from jaxswarm.learners import on_policy
from jaxswarm.learners.on_policy import Batch, LearnerState, Params
from jaxswarm.rollout import Trajectory
from jaxswarm.types import Key, Metrics, is_whole, pytree, require, static


@pytree
class PPO:
    """Hyper-parameters of PPO, and the learner.

    A minibatch has `batch_size` samples: rows of single agents drawn at random, or those of all agents of randomly
    drawn worlds, which is faster because the agents of a world share most of the work of perceiving it. With
    `bootstrap_truncation` the value of the last state stands for what would have come after a time limit; without,
    a time limit counts as the end of the world, as in the thesis.
    """

    learning_rate: float = 3e-3
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    value_coefficient: float = 0.5
    entropy_coefficient: float = 0.0
    max_gradient_norm: float = 0.5
    adam_epsilon: float = 1e-5
    num_epochs: int = static(default=2)
    batch_size: int = static(default=1280)
    minibatch: Literal["agents", "worlds"] = static(default="worlds")
    bootstrap_truncation: bool = static(default=True)

    def __post_init__(self) -> None:
        require(
            self,
            "positive numbers",
            lambda x: x > 0,
            "learning_rate",
            "clip_range",
            "max_gradient_norm",
            "adam_epsilon",
        )
        require(self, "numbers from 0 to 1", lambda x: 0 <= x <= 1, "discount", "gae_lambda")
        require(self, "numbers from 0", lambda x: x >= 0, "value_coefficient", "entropy_coefficient")
        require(self, "whole numbers from 1", is_whole(1), "num_epochs")
        require(self, "whole numbers from 2", is_whole(2), "batch_size")
        require(self, "agents, worlds", lambda x: x in ("agents", "worlds"), "minibatch")

    def init(self, params: Params) -> LearnerState:
        """State before the first update."""
        return LearnerState(params, self._optimizer().init(params))

    def update(
        self, key: Key, state: LearnerState, network: Any, task: Any, trajectory: Trajectory
    ) -> tuple[LearnerState, Metrics]:
        """Learns from one trajectory, all epochs."""
        value, next_value = on_policy.trajectory_values(network, state.params, task, trajectory)
        is_done = trajectory.terminated | trajectory.truncated
        is_terminal = trajectory.terminated if self.bootstrap_truncation else is_done
        advantage = on_policy.generalized_advantages(
            trajectory.reward, is_terminal, is_done, value, next_value, self.discount, self.gae_lambda
        )
        target = advantage + value
        samples = on_policy.stored_samples(task, trajectory, advantage, target)
        num_samples = advantage.size
        state, metrics = on_policy.descend(
            key,
            lambda params, batch: self.loss(network, params, batch),
            partial(on_policy.FETCH[self.minibatch], task, samples),
            self._optimizer(),
            state,
            num_samples if self.minibatch == "agents" else num_samples // task.num_agents,
            num_samples // self.batch_size,
            self.num_epochs,
        )
        return state, metrics | {"explained_variance": on_policy.explained_variance(value, target)}

    def loss(self, network: Any, params: Params, batch: Batch) -> tuple[Float[Array, ""], Metrics]:
        """Clipped surrogate, squared value error and entropy bonus of a minibatch; advantages are normalised in it."""
        policy, value = network.apply(params, batch.obs)
        log_ratio = policy.log_prob(batch.action) - batch.log_prob
        ratio = jnp.exp(log_ratio)
        advantage = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std(ddof=1) + 1e-8)
        clipped = jnp.clip(ratio, 1.0 - self.clip_range, 1.0 + self.clip_range)
        policy_loss = -jnp.minimum(ratio * advantage, clipped * advantage).mean()
        value_loss = jnp.square(value - batch.target).mean()
        entropy = policy.entropy().mean()
        metrics = {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "entropy": entropy,
            "approx_kl": (ratio - 1.0 - log_ratio).mean(),
            "clip_fraction": (jnp.abs(ratio - 1.0) > self.clip_range).mean(),
            "policy_std": policy.stddev().mean(),
        }
        loss = policy_loss + self.value_coefficient * value_loss - self.entropy_coefficient * entropy
        return loss, jax.lax.stop_gradient(metrics)

    def _optimizer(self) -> optax.GradientTransformation:
        return optax.chain(
            optax.clip_by_global_norm(self.max_gradient_norm),
            optax.adam(self.learning_rate, eps=self.adam_epsilon),
        )
