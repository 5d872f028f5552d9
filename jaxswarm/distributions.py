"""Action distributions of policies; only this module imports distrax."""

import distrax
import jax.numpy as jnp
from jaxtyping import Array, Float

Policy = distrax.MultivariateNormalDiag


def gaussian(mean: Float[Array, "*batch dim"], log_std: Float[Array, "*#batch dim"]) -> Policy:
    """Return the diagonal Gaussian with this mean and log standard deviation."""
    return gaussian_with_std(mean, jnp.exp(log_std))


def gaussian_with_std(mean: Float[Array, "*batch dim"], std: Float[Array, "*#batch dim"]) -> Policy:
    """Return the diagonal Gaussian with this mean and standard deviation."""
    return distrax.MultivariateNormalDiag(mean, jnp.broadcast_to(std, mean.shape))


def mean_and_std(policy: Policy) -> tuple[Float[Array, "*batch dim"], Float[Array, "*batch dim"]]:
    """Return the mean and the standard deviation of each dimension."""
    return jnp.asarray(policy.mean()), jnp.asarray(policy.stddev())
