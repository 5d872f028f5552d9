"""Trust region projections of diagonal Gaussians (Otto et al., "Differentiable Trust Region Layers", 2021).

A projection replaces a policy by the nearest policy whose mean and standard deviation are each within a bound of those
of the old policy. Each row is projected independently; rows within a bound are returned bit for bit. The projections
consist of elementwise formulas and of sums over action dimensions, so they can be compiled, batched and differentiated.
The old policy and the bounds are constants for gradients.

The same bound means different things to different projections. Near the old policy, a bound of 0.03 lets the mean move
by 0.24 old standard deviations with `kl`, by 0.17 with the others (by 0.17 in absolute units with `_unscaled`). The
distances `cov_part` of `kl` and `wasserstein` are equal near the old policy. That of `frobenius` is 4 old_std^4 times
as large, so its bound is either tight or without effect.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxswarm.distributions import Policy, gaussian_with_std, mean_and_std

NUM_ROOT_STEPS = 5  # of the root finding of `kl` for bounds up to 1; 2 suffice up to 0.05, 4 up to 1
NUM_ROOT_STEPS_LARGE_BOUND = 12  # for bounds above 1

Bound = Float[Array, ""] | float


@dataclasses.dataclass(frozen=True)
class Projection:
    """Distances of a policy from the old policy, and the nearest standard deviation within a bound.

    Means are [*batch, dim]. Standard deviations have the same shape, or axes of size 1. Distances are [*batch].
    """

    mean_part: Callable[[Array, Array, Array], Array]  # of mean, old mean, old standard deviation
    cov_part: Callable[[Array, Array], Array]  # of standard deviation, old standard deviation
    project_std: Callable[[Array, Array, Any], Array]  # of the same and the bound of `cov_part`

    def __call__(self, policy: Policy, old_policy: Policy, mean_bound: Bound, cov_bound: Bound) -> Policy:
        """Return the policy within the bounds that is nearest to `policy`."""
        mean, std = mean_and_std(policy)
        (old_mean, old_std), mean_bound, cov_bound = jax.lax.stop_gradient(
            (mean_and_std(old_policy), mean_bound, cov_bound)
        )
        mean = self.project_mean(mean, old_mean, old_std, mean_bound)
        return gaussian_with_std(mean, self.project_std(std, old_std, cov_bound))

    def project_mean(
        self,
        mean: Float[Array, "*batch dim"],
        old_mean: Float[Array, "*batch dim"],
        old_std: Float[Array, "*#batch dim"],
        bound: Bound,
    ) -> Float[Array, "*batch dim"]:
        """Return the mean or, if it is outside the bound, the point at the bound on the line to the old mean."""
        is_outside, fraction = _bound_fraction(self.mean_part(mean, old_mean, old_std), bound)
        return jnp.where(is_outside, old_mean + fraction * (mean - old_mean), mean)


def mahalanobis(
    mean: Float[Array, "*batch dim"], old_mean: Float[Array, "*batch dim"], old_std: Float[Array, "*#batch dim"]
) -> Float[Array, "*batch"]:
    """Return the sum of ((mean - old_mean) / old_std)^2."""
    return jnp.square((mean - old_mean) / old_std).sum(-1)


def half_mahalanobis(
    mean: Float[Array, "*batch dim"], old_mean: Float[Array, "*batch dim"], old_std: Float[Array, "*#batch dim"]
) -> Float[Array, "*batch"]:
    """Return the part of the Kullback-Leibler divergence that is due to the means: half of `mahalanobis`."""
    return 0.5 * mahalanobis(mean, old_mean, old_std)


def euclidean(
    mean: Float[Array, "*batch dim"], old_mean: Float[Array, "*batch dim"], old_std: Float[Array, "*#batch dim"]
) -> Float[Array, "*batch"]:
    """Return the sum of (mean - old_mean)^2."""
    del old_std
    return jnp.square(mean - old_mean).sum(-1)


def wasserstein(std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"]) -> Float[Array, "*batch"]:
    """Return the squared 2-Wasserstein distance of centered Gaussians, in units of the old standard deviations."""
    return jnp.square((std - old_std) / old_std).sum(-1)


def wasserstein_unscaled(
    std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"]
) -> Float[Array, "*batch"]:
    """Return the squared 2-Wasserstein distance of centered Gaussians."""
    return jnp.square(std - old_std).sum(-1)


def project_std_wasserstein(
    distance: Callable[[Array, Array], Array],
    std: Float[Array, "*batch dim"],
    old_std: Float[Array, "*batch dim"],
    bound: Bound,
) -> Float[Array, "*batch dim"]:
    """Return the point at the bound on the line to the old standard deviation, for either Wasserstein distance."""
    is_outside, fraction = _bound_fraction(distance(std, old_std), bound)
    return jnp.where(is_outside, _interpolate(std, old_std, std - old_std, fraction), std)


def frobenius(std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"]) -> Float[Array, "*batch"]:
    """Return the squared Frobenius norm of the difference of the covariance matrices."""
    return jnp.square((std - old_std) * (std + old_std)).sum(-1)


def project_std_frobenius(
    std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"], bound: Bound
) -> Float[Array, "*batch dim"]:
    """Return the square root of the point at the bound on the line between the variances."""
    is_outside, fraction = _bound_fraction(frobenius(std, old_std), bound)
    difference = (std - old_std) * (std + old_std)
    variance = _interpolate(jnp.square(std), jnp.square(old_std), difference, fraction)
    return jnp.where(is_outside, jnp.sqrt(variance), std)


def _bound_fraction(
    squared_distance: Float[Array, "*batch"], bound: Bound
) -> tuple[Bool[Array, "*batch 1"], Float[Array, "*batch 1"]]:
    """Return whether a row is outside the bound, and the fraction of its distance that remains at the bound."""
    is_outside = squared_distance > bound
    fraction = jnp.sqrt(bound / jnp.where(is_outside, squared_distance, bound))
    return is_outside[..., None], fraction[..., None]


def _interpolate(
    x: Float[Array, "*batch dim"],
    old: Float[Array, "*batch dim"],
    difference: Float[Array, "*batch dim"],
    fraction: Float[Array, "*batch 1"],
) -> Float[Array, "*batch dim"]:
    """Return old + fraction * difference for positive `x` and `old` that differ by `difference`.

    The result is positive despite rounding.
    """
    return jnp.where(difference < 0, x - (1.0 - fraction) * difference, old + fraction * difference)


def kl(std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"]) -> Float[Array, "*batch"]:
    """Return the Kullback-Leibler divergence of centered Gaussians.

    It is half the sum of x - 1 - ln x with x = (std / old_std)^2.
    """
    t = (old_std - std) * (old_std + std) / jnp.square(old_std)
    return 0.5 * _divergence(t, 2.0 * jnp.log(old_std / std)).sum(-1)


@jax.custom_jvp
def project_std_kl(
    std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"], bound: Bound
) -> Float[Array, "*batch dim"]:
    """Return the centered Gaussian with least divergence to the new one among those within the bound of the old one.

    Outside the bound, precisions are averaged: 1 / projected^2 = s / std^2 + (1 - s) / old_std^2, with s in (0, 1)
    such that the divergence equals the bound. For bounds up to 30, s is exact to nine digits or to rounding.

    The derivative is that of the implicit function, with respect to `std` only. In logarithms it is
    (I - t t' / t't) diag(w), where t = 1 - (projected / old_std)^2 is normal to the ball and w = s (projected / std)^2.
    """
    return _solve_kl(std, old_std, bound)[0]


@project_std_kl.defjvp
def _project_std_kl_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    std, old_std, bound = primals
    projected, is_outside, s, t = _solve_kl(std, old_std, bound)
    towards_new = s * jnp.square(projected / std) * tangents[0] / std
    normal = (t * towards_new).sum(-1, keepdims=True) / jnp.where(is_outside, jnp.square(t).sum(-1, keepdims=True), 1.0)
    return projected, jnp.where(is_outside, projected * (towards_new - normal * t), tangents[0])


def _solve_kl(
    std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"], bound: Bound
) -> tuple[Float[Array, "*batch dim"], Bool[Array, "*batch 1"], Float[Array, "*batch 1"], Float[Array, "*batch dim"]]:
    """Return the projected standard deviation, whether a row is outside the bound, and s and t (arbitrary inside)."""
    divergence = kl(std, old_std)
    is_outside = (divergence > bound)[..., None]
    a = jnp.where(is_outside, (old_std - std) * (old_std + std) / jnp.square(std), 1.0)
    s = _root(jnp.moveaxis(a, -1, 0), bound, divergence < 2.0 * bound)[..., None]
    u = s * a
    return jnp.where(is_outside, old_std * jax.lax.rsqrt(1.0 + u), std), is_outside, s, u / (1.0 + u)


def _root(a: Float[Array, "dim *batch"], bound: Bound, is_near_one: Bool[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the s in (0, 1] at which h(s), half the sum of log1p(s a) - s a / (1 + s a), equals the bound; a > -1.

    h grows with s from h(0) = 0. The method takes Newton steps for ln h as a function of y = ln s with a correction for
    curvature (Halley). A bracket contains the root; bisection replaces a step that leaves the bracket. The search for a
    root near the upper end of the bracket starts there, because steps from below would always leave it. With
    u = s a and t = u / (1 + u), two derivatives are almost free: dh / dy = sum t^2 / 2, whose derivative is
    sum t^2 (1 - t).

    The dimensions are the first axis, and the steps are a loop. Both together are three to five times as fast on a CPU
    as the alternatives.
    """

    def step(_: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, y = state
        u = jnp.exp(y)[None] * a
        t = u / (1.0 + u)
        square = jnp.square(t)
        h = 0.5 * _divergence(t, jnp.log1p(u)).sum(0)
        excess = jnp.log(h / bound)
        slope = 0.5 * square.sum(0) / h
        curvature = (square * (1.0 - t)).sum(0) / h - jnp.square(slope)
        low, high = jnp.where(excess > 0, low, y), jnp.where(excess > 0, y, high)
        newton = excess / slope
        y = y - newton / (1.0 - 0.5 * newton * curvature / slope)
        return low, high, jnp.where((y >= low) & (y <= high), y, 0.5 * (low + high))

    low, high = _bracket(a, bound)
    start = jnp.where(is_near_one, high, 0.5 * (low + high))
    num_steps = jnp.where(bound > 1.0, NUM_ROOT_STEPS_LARGE_BOUND, NUM_ROOT_STEPS)
    return jnp.exp(jax.lax.fori_loop(0, num_steps, step, (low, high, start))[2])


def _bracket(a: Float[Array, "dim *batch"], bound: Bound) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Return the logarithms of a lower and an upper bound of the root, which are 4 sqrt(bound) apart for small bounds.

    They follow from u^2 / (1 + p)^2 <= 2 (log1p(u) - t) <= u^2 / (1 - n)^2 for u in [-n, p], and for the largest u from
    log1p(u) - 1 < log1p(u) - t.
    """
    tiny = jnp.finfo(a.dtype).tiny
    positive, negative = jnp.maximum(a.max(0), 0.0), jnp.maximum(-a.min(0), 0.0)
    scale = jnp.maximum(positive, negative)  # without it, squares would overflow
    s = 2.0 * jnp.sqrt(bound / jnp.square(a / scale[None]).sum(0)) / scale
    room = 1.0 - s * positive
    high = jnp.where(room > 0.0, s / jnp.maximum(room, tiny), jnp.inf)
    high = jnp.minimum(jnp.minimum(high, jnp.expm1(2.0 * bound + 1.0) / jnp.maximum(positive, tiny)), 1.0)
    return jnp.log(jnp.minimum(s / (1.0 + s * negative), high)), jnp.log(high)


def _divergence(t: Float[Array, "*batch dim"], log: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """Return log - t, with log = -log(1 - t).

    Near 0 it uses the series, which avoids cancellation (relative error below 1e-10).
    """
    is_near = jnp.abs(t) < 0.1
    near = jnp.where(is_near, t, 0.0)
    series = jnp.zeros_like(t)
    for n in range(10, 1, -1):
        series = series * near + 1.0 / n
    return jnp.where(is_near, series * jnp.square(near), log - t)


PROJECTIONS = {
    "kl": Projection(half_mahalanobis, kl, project_std_kl),
    "wasserstein": Projection(mahalanobis, wasserstein, partial(project_std_wasserstein, wasserstein)),
    "wasserstein_unscaled": Projection(
        euclidean, wasserstein_unscaled, partial(project_std_wasserstein, wasserstein_unscaled)
    ),
    "frobenius": Projection(mahalanobis, frobenius, project_std_frobenius),
    # Only the distance of the means is unscaled here; that of the covariances is never scaled.
    "frobenius_unscaled": Projection(euclidean, frobenius, project_std_frobenius),
}


def entropy(std: Float[Array, "*batch dim"]) -> Float[Array, "*batch"]:
    """Return the differential entropy of diagonal Gaussians in nats."""
    return jnp.log(std).sum(-1) + 0.5 * std.shape[-1] * jnp.log(2.0 * jnp.pi * jnp.e)


def control_entropy(
    std: Float[Array, "*batch dim"], target: Float[Array, "*#batch"] | float, *, is_equality: bool
) -> Float[Array, "*batch dim"]:
    """Return standard deviations that are scaled to an entropy of `target` nats.

    Without `is_equality`, only those with less entropy are scaled.
    """
    log_scale = (target - entropy(std)) / std.shape[-1]
    return std * jnp.exp(log_scale if is_equality else jnp.maximum(log_scale, 0.0))[..., None]


def linear(initial: Bound, target: Bound, progress: Bound, temperature: Bound) -> Bound:
    """Return the entropy on the line from `initial` to `target`; progress is from 0 to 1."""
    del temperature
    return initial + progress * (target - initial)


def exponential(initial: Bound, target: Bound, progress: Bound, temperature: Bound) -> Bound:
    """Return an entropy that approaches `target` exponentially; progress is from 0 to 1.

    Every tenth of the progress multiplies the distance from `target` by `temperature`.
    """
    return target + (initial - target) * temperature ** (10.0 * progress)


ENTROPY_SCHEDULES = {"linear": linear, "exponential": exponential}
