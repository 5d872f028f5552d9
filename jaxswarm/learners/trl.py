"""Policy gradients within trust region layers (Otto et al., 2021)."""

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
from jaxswarm.networks import map_log_std
from jaxswarm.rollout import Trajectory
from jaxswarm.types import Key, Metrics, pytree, static


@pytree
class TRLState(LearnerState):
    """And what the schedule of the entropy starts from."""

    num_updates: Int[Array, ""]  # done
    initial_entropy: Float[Array, ""]  # mean over the first trajectory


@pytree
class TRL(OnPolicy):
    """Hyper-parameters of policy gradients with trust region layers, and the learner.

    The layer projects every policy to within `mean_bound` and `cov_bound` of the one that acted. With
    `objective="projected"`, the published algorithm, the policy gradient is that of the projected policy. With "raw",
    which the thesis ran, it is that of the network's own policy, and only the regression loss knows of the projection.

    The regression loss, weighted by `coefficient`, draws the network to the projected policy, since actions are sampled
    from the network itself. It is the part of the mean and, with a state-dependent standard deviation, also that of the
    covariance. A shared standard deviation is instead projected after the last step, so that it stays within its bound
    exactly; not with "raw", which leaves it free.

    Entropy control scales the projected standard deviation to at least (or exactly) a scheduled entropy, even beyond
    the bound; the schedule goes from the entropy of the first trajectory to `target_entropy` (nats, of all dimensions
    together) in `entropy_updates` updates. Unlike the published program, one Adam descends for actor and critic.
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
        """The kind of projection."""
        return PROJECTIONS[self.projection]

    def init(self, params: Params) -> TRLState:
        """State before the first update."""
        return TRLState(params, on_policy.adam(self).init(params), jnp.zeros((), jnp.int32), jnp.zeros(()))

    def update(
        self, key: Key, state: TRLState, network: Any, task: Any, trajectory: Trajectory
    ) -> tuple[TRLState, Metrics]:
        """Learns from one trajectory, all epochs."""
        first = on_policy.mean(entropy(trajectory.action_std), trajectory.mask)
        state = dataclasses.replace(
            state,
            num_updates=state.num_updates + 1,
            initial_entropy=jnp.where(state.num_updates == 0, first, state.initial_entropy),
        )
        least_entropy = self.scheduled_entropy(state)

        def loss(params: Params, batch: Minibatch) -> tuple[Array, Metrics]:
            return self.loss(network, params, batch, least_entropy)

        state, metrics = on_policy.update(self, loss, key, state, network, task, trajectory)
        if self.objective == "projected" and network.std == "shared":
            old_std = trajectory.action_std.reshape(-1, task.action_dim)[:1]

            def projected(log_std: Array) -> Array:
                return jnp.log(self._project_std(jnp.exp(log_std)[None], old_std, least_entropy))[0]

            state = dataclasses.replace(state, params=map_log_std(projected, state.params))
        return state, metrics

    def scheduled_entropy(self, state: TRLState) -> Float[Array, ""]:
        """Entropy to be kept in the update of this number."""
        progress = jnp.minimum(state.num_updates / self.entropy_updates, 1.0)
        schedule = ENTROPY_SCHEDULES[self.entropy_schedule]
        return jnp.asarray(schedule(state.initial_entropy, self.target_entropy, progress, self.entropy_temperature))

    def loss(
        self, network: Any, params: Params, batch: Minibatch, least_entropy: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Metrics]:
        """Surrogate, regression loss, squared value error and entropy bonus of a minibatch."""
        assert batch.action_mean is not None
        assert batch.action_std is not None
        mask = batch.obs.mask
        average = partial(on_policy.mean, mask=mask)
        rows = slice(1) if network.std == "shared" else slice(None)  # of which the others are copies
        policy, value = network.apply(params, batch.obs)
        mean, std = policy.mean(), policy.stddev()[rows]
        old_mean, old_std = batch.action_mean, batch.action_std[rows]
        projected_mean = self.layer.project_mean(mean, old_mean, old_std, self.mean_bound)
        projected_std = self._project_std(std, old_std, least_entropy)

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
        """How far the network's own policy is from the one that acted."""
        average, most = (partial(reduce, mask=mask) for reduce in (on_policy.mean, on_policy.maximum))
        mean_part = self.layer.mean_part(mean, old_mean, old_std)
        cov_part = self.layer.cov_part(std, old_std)
        is_outside = (mean_part > self.mean_bound) | (cov_part > self.cov_bound)
        return {
            "mean_part": average(mean_part),
            "mean_part_max": most(mean_part),
            "cov_part": average(cov_part),
            "cov_part_max": most(cov_part),
            "projected_fraction": average(is_outside.astype(jnp.float32)),
        }

    def _project_std(
        self, std: Float[Array, "rows dim"], old_std: Float[Array, "rows dim"], least_entropy: Float[Array, ""]
    ) -> Float[Array, "rows dim"]:
        std = self.layer.project_std(std, old_std, self.cov_bound)
        if self.entropy_control == "none":
            return std
        is_equality = self.entropy_control == "equality"
        return control_entropy(std, least_entropy[None], is_equality=is_equality)
