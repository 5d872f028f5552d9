"""Policy gradients with trust region layers (Otto et al., 2021)."""

import dataclasses
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.distributions import gaussian_with_std
from jaxswarm.learners import on_policy
from jaxswarm.learners.on_policy import LearnerState, Mask, Minibatch, OnPolicy, Params
from jaxswarm.learners.projections import ENTROPY_SCHEDULES, PROJECTIONS, Projection, control_entropy, entropy
from jaxswarm.networks import Network, map_log_std
from jaxswarm.rollout import Trajectory
from jaxswarm.types import Key, Metrics, pytree, static


@pytree
class TRLState(LearnerState):
    """Learner state plus the initial entropy, from which the entropy schedule starts."""

    num_updates: Int[Array, ""]  # so far
    initial_entropy: Float[Array, ""]  # nats, mean over the first trajectory


@pytree
class TRL(OnPolicy):
    """Policy gradients with trust region layers and their hyperparameters; `OnPolicy` documents the inherited ones.

    The layer projects every policy to within `mean_bound` and `cov_bound` of the policy that acted. With
    `objective="projected"`, the published variant, the policy gradient is that of the projected policy. With
    `objective="raw"`, the thesis variant, it is that of the network's own policy, and only the regression loss uses the
    projection.

    Actions are sampled from the network's own policy, so the regression loss draws it to the projected policy. This
    loss is the distance of the means and, if the standard deviation depends on the state, of the covariances. A shared
    standard deviation is instead projected after the last gradient step, so that it is exactly within its bound; with
    `objective="raw"` it is not projected.

    Entropy control scales the projected standard deviation to at least (or exactly) a scheduled entropy, even beyond
    the bound. The schedule starts from the entropy of the first trajectory. Unlike the published program, one Adam
    optimizer updates actor and critic.

    Attributes:
        projection: This projection defines the distances and bounds: `kl`, `wasserstein` or `frobenius`, or
            `wasserstein_unscaled` or `frobenius_unscaled`, which do not use units of the old standard deviation.
        objective: The policy gradient is that of the projected policy (`projected`), as published, or of the network's
            own policy (`raw`), as in the thesis.
        mean_bound: The projected mean is at most this far from the mean of the policy that acted (> 0, as a distance
            of `projection`).
        cov_bound: The projected standard deviation is at most this far from that of the policy that acted (> 0, as a
            distance of `projection`).
        regression_coefficient: The total loss contains the regression loss, which draws the network to the projected
            policy, with this weight (> 0).
        entropy_control: The scheduled entropy is ignored (`none`), a lower bound of the entropy (`inequality`) or its
            exact value (`equality`).
        entropy_schedule: The scheduled entropy goes from the initial entropy to `target_entropy` on a line (`linear`)
            or exponentially (`exponential`).
        target_entropy: The scheduled entropy ends at this value (nats, summed over all dimensions of the action).
        entropy_updates: The schedule of the entropy takes this many updates (> 0).
        entropy_temperature: The exponential schedule multiplies the distance from `target_entropy` by this factor
            (above 0, below 1) in every tenth of `entropy_updates`.
    """

    projection: str = static(default="wasserstein")
    objective: Literal["projected", "raw"] = static(default="projected")
    mean_bound: float = 0.03
    cov_bound: float = 0.001
    regression_coefficient: float = 8.0
    entropy_control: Literal["none", "inequality", "equality"] = static(default="none")
    entropy_schedule: Literal["linear", "exponential"] = static(default="linear")
    target_entropy: float = 0.0
    entropy_updates: float = 100.0
    entropy_temperature: float = 0.5

    def __post_init__(self) -> None:
        on_policy.check(self)
        require(
            self,
            checks.POSITIVE,
            "mean_bound",
            "cov_bound",
            "regression_coefficient",
            "entropy_updates",
        )
        require(self, checks.Check("a number above 0 and below 1", lambda x: 0 < x < 1), "entropy_temperature")
        for name, accepted in {
            "projection": tuple(PROJECTIONS),
            "objective": ("projected", "raw"),
            "entropy_control": ("none", "inequality", "equality"),
            "entropy_schedule": tuple(ENTROPY_SCHEDULES),
        }.items():
            require(self, checks.choice(accepted), name)
        if self.objective == "raw" and self.entropy_control != "none":
            raise ValueError(
                "entropy_control: must be none with objective='raw', whose policy is never projected, "
                f"got {self.entropy_control!r}"
            )

    @property
    def layer(self) -> Projection:
        """Distances and projections that `projection` names."""
        return PROJECTIONS[self.projection]

    def init(self, params: Params) -> TRLState:
        """Return the state before the first update."""
        return TRLState(params, on_policy.adam(self).init(params), jnp.zeros((), jnp.int32), jnp.zeros(()))

    def update(
        self, key: Key, state: TRLState, network: Network, task: Any, trajectory: Trajectory
    ) -> tuple[TRLState, Metrics]:
        """Update the parameters from one trajectory, in all epochs."""
        first = on_policy.mean(entropy(trajectory.action_std), trajectory.mask)
        state = dataclasses.replace(
            state,
            num_updates=state.num_updates + 1,
            initial_entropy=jnp.where(state.num_updates == 0, first, state.initial_entropy),
        )
        entropy_bound = self.scheduled_entropy(state)

        def loss(params: Params, batch: Minibatch) -> tuple[Array, Metrics]:
            return self.loss(network, params, batch, entropy_bound)

        state, metrics = on_policy.update(self, loss, key, state, network, task, trajectory)
        if self.objective == "projected" and network.std == "shared":
            old_std = trajectory.action_std.reshape(-1, task.action_dim)[:1]

            def projected(log_std: Array) -> Array:
                return jnp.log(self._project_std(jnp.exp(log_std)[None], old_std, entropy_bound))[0]

            state = dataclasses.replace(state, params=map_log_std(projected, state.params))
        return state, metrics

    def scheduled_entropy(self, state: TRLState) -> Float[Array, ""]:
        """Return the scheduled entropy in nats after `state.num_updates` updates."""
        progress = jnp.minimum(state.num_updates / self.entropy_updates, 1.0)
        schedule = ENTROPY_SCHEDULES[self.entropy_schedule]
        return jnp.asarray(schedule(state.initial_entropy, self.target_entropy, progress, self.entropy_temperature))

    def loss(
        self, network: Network, params: Params, batch: Minibatch, entropy_bound: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Metrics]:
        """Return surrogate plus regression loss plus value loss minus entropy bonus, and metrics, of a minibatch."""
        assert batch.action_mean is not None
        assert batch.action_std is not None
        mask = batch.obs.mask
        average = partial(on_policy.mean, mask=mask)
        # All rows of a shared standard deviation are equal, so one suffices.
        rows = slice(1) if network.std == "shared" else slice(None)
        policy, value = network.apply(params, batch.obs)
        mean, std = policy.mean(), policy.stddev()[rows]
        old_mean, old_std = batch.action_mean, batch.action_std[rows]
        projected_mean = self.layer.project_mean(mean, old_mean, old_std, self.mean_bound)
        projected_std = self._project_std(std, old_std, entropy_bound)

        if self.objective == "projected":
            policy = gaussian_with_std(projected_mean, projected_std)
        log_ratio = policy.log_prob(batch.action) - batch.log_prob
        ratio = jnp.exp(log_ratio)
        policy_loss = -average(ratio * on_policy.standardized(batch.advantage, mask))
        value_loss = on_policy.squared_error(value, batch.target, mask)
        goal = jax.lax.stop_gradient((projected_mean, projected_std))
        regression = self.layer.mean_part(mean, *goal)
        if network.std == "state":
            regression += self.layer.cov_part(std, goal[1])
        regression_loss = self.regression_coefficient * average(regression)
        bonus = average(jnp.asarray(policy.entropy()))

        metrics = {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "regression_loss": regression_loss,
            "entropy": bonus,
            "approx_kl": average(ratio - 1.0 - log_ratio),
            "policy_std": average(policy.stddev().mean(-1)),
        } | self._distances(mean, std, old_mean, old_std, mask)
        loss = policy_loss + regression_loss + self.value_coefficient * value_loss - self.entropy_coefficient * bonus
        return loss, jax.lax.stop_gradient(metrics)

    def _distances(
        self,
        mean: Float[Array, "rows dim"],
        std: Float[Array, "#rows dim"],
        old_mean: Float[Array, "rows dim"],
        old_std: Float[Array, "#rows dim"],
        mask: Mask,
    ) -> Metrics:
        """Return the distances of the network's own policy from the policy that acted."""
        average, maximum = (partial(reduce, mask=mask) for reduce in (on_policy.mean, on_policy.maximum))
        mean_part = self.layer.mean_part(mean, old_mean, old_std)
        cov_part = self.layer.cov_part(std, old_std)
        is_outside = (mean_part > self.mean_bound) | (cov_part > self.cov_bound)
        return {
            "mean_part": average(mean_part),
            "mean_part_max": maximum(mean_part),
            "cov_part": average(cov_part),
            "cov_part_max": maximum(cov_part),
            "projected_fraction": average(is_outside.astype(jnp.float32)),
        }

    def _project_std(
        self, std: Float[Array, "rows dim"], old_std: Float[Array, "rows dim"], entropy_bound: Float[Array, ""]
    ) -> Float[Array, "rows dim"]:
        std = self.layer.project_std(std, old_std, self.cov_bound)
        if self.entropy_control == "none":
            return std
        is_equality = self.entropy_control == "equality"
        return control_entropy(std, entropy_bound[None], is_equality=is_equality)
