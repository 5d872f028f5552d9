"""Trust region projections of diagonal Gaussians (Otto et al., "Differentiable Trust Region Layers", 2021).

A projection replaces a policy by the nearest one whose mean and standard deviation are each within a bound of the old
policy's. Every row is projected by itself, and rows within a bound come back bit by bit. All is elementwise formulas
and sums over the action's dimensions, to be compiled, batched and differentiated; old policy and bounds are constants.

Bounds of different kinds are different sizes: near the old policy, a bound of 0.03 lets the mean move by 0.24 old
standard deviations with `kl`, by 0.17 with the others (by 0.17 itself with `_unscaled`). The covariance's parts of `kl`
and `wasserstein` are equal near the old policy; that of `frobenius` is 4 old_std^4 times as large, so it binds tightly
or not at all.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxswarm.distributions import Policy, gaussian_with_std, mean_and_std

NUM_STEPS = 5  # of the root finding of `kl`: 2 suffice for bounds up to 0.05, 4 up to 1
NUM_STEPS_FAR = 12  # for larger bounds

Bound = Float[Array, ""] | float


@dataclasses.dataclass(frozen=True)
class Projection:
    """How far a policy is from the old one, in two parts, and the nearest standard deviation that is not too far.

    Means are `[*batch, dim]`; standard deviations the same, or with axes of size 1; parts `[*batch]`.
    """

    mean_part: Callable[[Array, Array, Array], Array]  # of mean, old mean, old standard deviation
    cov_part: Callable[[Array, Array], Array]  # of standard deviation, old standard deviation
    project_std: Callable[[Array, Array, Any], Array]  # of these and the bound of `cov_part`

    def __call__(self, policy: Policy, old_policy: Policy, mean_bound: Bound, cov_bound: Bound) -> Policy:
        """The policy within the bounds that is nearest to `policy`."""
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
        """The mean or, if it is outside, the point of the line to the old mean that is at the bound."""
        is_outside, fraction = _kept(self.mean_part(mean, old_mean, old_std), bound)
        return jnp.where(is_outside, old_mean + fraction * (mean - old_mean), mean)


def mahalanobis(
    mean: Float[Array, "*batch dim"], old_mean: Float[Array, "*batch dim"], old_std: Float[Array, "*#batch dim"]
) -> Float[Array, "*batch"]:
    """Sum of ((mean - old_mean) / old_std)^2."""
    return jnp.square((mean - old_mean) / old_std).sum(-1)


def half_mahalanobis(
    mean: Float[Array, "*batch dim"], old_mean: Float[Array, "*batch dim"], old_std: Float[Array, "*#batch dim"]
) -> Float[Array, "*batch"]:
    """The part of the Kullback-Leibler divergence that is due to the means."""
    return 0.5 * mahalanobis(mean, old_mean, old_std)


def euclidean(
    mean: Float[Array, "*batch dim"], old_mean: Float[Array, "*batch dim"], old_std: Float[Array, "*#batch dim"]
) -> Float[Array, "*batch"]:
    """Sum of (mean - old_mean)^2."""
    del old_std
    return jnp.square(mean - old_mean).sum(-1)


def wasserstein(std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"]) -> Float[Array, "*batch"]:
    """Squared 2-Wasserstein distance of centered Gaussians, in units of the old standard deviations."""
    return jnp.square((std - old_std) / old_std).sum(-1)


def wasserstein_unscaled(
    std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"]
) -> Float[Array, "*batch"]:
    """Squared 2-Wasserstein distance of centered Gaussians."""
    return jnp.square(std - old_std).sum(-1)


def project_std_wasserstein(
    distance: Callable[[Array, Array], Array],
    std: Float[Array, "*batch dim"],
    old_std: Float[Array, "*batch dim"],
    bound: Bound,
) -> Float[Array, "*batch dim"]:
    """The point of the line to the old standard deviation, for either distance."""
    is_outside, fraction = _kept(distance(std, old_std), bound)
    return jnp.where(is_outside, _between(std, old_std, std - old_std, fraction), std)


def frobenius(std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"]) -> Float[Array, "*batch"]:
    """Squared Frobenius norm of the difference of the covariance matrices."""
    return jnp.square((std - old_std) * (std + old_std)).sum(-1)


def project_std_frobenius(
    std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"], bound: Bound
) -> Float[Array, "*batch dim"]:
    """Square root of the point of the line between the variances."""
    is_outside, fraction = _kept(frobenius(std, old_std), bound)
    difference = (std - old_std) * (std + old_std)
    variance = _between(jnp.square(std), jnp.square(old_std), difference, fraction)
    return jnp.where(is_outside, jnp.sqrt(variance), std)


def _kept(
    squared_distance: Float[Array, "*batch"], bound: Bound
) -> tuple[Bool[Array, "*batch 1"], Float[Array, "*batch 1"]]:
    """Whether a row is outside the bound, and what fraction of its distance remains when it is moved to the bound."""
    is_outside = squared_distance > bound
    fraction = jnp.sqrt(bound / jnp.where(is_outside, squared_distance, bound))
    return is_outside[..., None], fraction[..., None]


def _between(
    x: Float[Array, "*batch dim"],
    old: Float[Array, "*batch dim"],
    difference: Float[Array, "*batch dim"],
    fraction: Float[Array, "*batch 1"],
) -> Float[Array, "*batch dim"]:
    """old + fraction * difference, for positive numbers that differ by `difference`; no rounding makes it 0 or less."""
    return jnp.where(difference < 0, x - (1.0 - fraction) * difference, old + fraction * difference)


def kl(std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"]) -> Float[Array, "*batch"]:
    """Kullback-Leibler divergence of centered Gaussians: half the sum of x - 1 - ln x, with x = (std / old_std)^2."""
    t = (old_std - std) * (old_std + std) / jnp.square(old_std)
    return 0.5 * _divergence(t, 2.0 * jnp.log(old_std / std)).sum(-1)


@jax.custom_jvp
def project_std_kl(
    std: Float[Array, "*batch dim"], old_std: Float[Array, "*batch dim"], bound: Bound
) -> Float[Array, "*batch dim"]:
    """The centered Gaussian of least divergence to the new one whose divergence to the old one is within the bound.

    Where it is outside, precisions are averaged: 1 / projected^2 = s / std^2 + (1 - s) / old_std^2, with s in (0, 1)
    such that the divergence is the bound. For bounds up to 30, s is exact to nine digits or to rounding.

    The derivative is that of the implicit function, for `std` alone. In logarithms it is (I - t t' / t't) diag(w),
    where t = 1 - (projected / old_std)^2 is normal to the ball and w = s (projected / std)^2.
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
    """The projected standard deviation, whether a row is outside, and its s and t (arbitrary inside)."""
    divergence = kl(std, old_std)
    is_outside = (divergence > bound)[..., None]
    a = jnp.where(is_outside, (old_std - std) * (old_std + std) / jnp.square(std), 1.0)
    s = _root(jnp.moveaxis(a, -1, 0), bound, divergence < 2.0 * bound)[..., None]
    u = s * a
    return jnp.where(is_outside, old_std * jax.lax.rsqrt(1.0 + u), std), is_outside, s, u / (1.0 + u)


def _root(a: Float[Array, "dim *batch"], bound: Bound, is_near_one: Bool[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The s in (0, 1] where h(s) = half the sum of log1p(s a) - s a / (1 + s a) is the bound; a > -1.

    h grows with s from h(0) = 0. Newton's steps for ln h as a function of y = ln s, corrected for curvature (Halley),
    in a bracket; a step that leaves the bracket becomes a bisection. A root near the bracket's upper end is approached
    from there, because steps from below would leave the bracket for ever. With u = s a and t = u / (1 + u), two
    derivatives are almost free: dh / dy = sum t^2 / 2, whose derivative is sum t^2 (1 - t).

    Dimensions come first, and the steps are a loop: three to five times as fast on a CPU as the opposites.
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
    num_steps = jnp.where(bound > 1.0, NUM_STEPS_FAR, NUM_STEPS)
    return jnp.exp(jax.lax.fori_loop(0, num_steps, step, (low, high, start))[2])


def _bracket(a: Float[Array, "dim *batch"], bound: Bound) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Logarithms of numbers below and above the root, which for small bounds are 4 sqrt(bound) apart.

    They follow from u^2 / (1 + p)^2 <= 2 (log1p(u) - t) <= u^2 / (1 - n)^2 for u in [-n, p], and for the largest u from
    log1p(u) - 1 < log1p(u) - t.
    """
    tiny = jnp.finfo(a.dtype).tiny
    positive, negative = jnp.maximum(a.max(0), 0.0), jnp.maximum(-a.min(0), 0.0)
    scale = jnp.maximum(positive, negative)  # squares of unscaled numbers would overflow
    s = 2.0 * jnp.sqrt(bound / jnp.square(a / scale[None]).sum(0)) / scale
    room = 1.0 - s * positive
    high = jnp.where(room > 0.0, s / jnp.maximum(room, tiny), jnp.inf)
    high = jnp.minimum(jnp.minimum(high, jnp.expm1(2.0 * bound + 1.0) / jnp.maximum(positive, tiny)), 1.0)
    return jnp.log(jnp.minimum(s / (1.0 + s * negative), high)), jnp.log(high)


def _divergence(t: Float[Array, "*batch dim"], log: Float[Array, "*batch dim"]) -> Float[Array, "*batch dim"]:
    """log - t, with log = -log(1 - t); near 0 by its series, which does not cancel (relative error below 1e-10)."""
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
    "frobenius_unscaled": Projection(euclidean, frobenius, project_std_frobenius),  # of the mean; the other never is
}


def entropy(std: Float[Array, "*batch dim"]) -> Float[Array, "*batch"]:
    """Differential entropy in nats."""
    return jnp.log(std).sum(-1) + 0.5 * std.shape[-1] * jnp.log(2.0 * jnp.pi * jnp.e)


def control_entropy(
    std: Float[Array, "*batch dim"], target: Float[Array, "*#batch"] | float, *, is_equality: bool
) -> Float[Array, "*batch dim"]:
    """Standard deviations, scaled to an entropy of `target`; without `is_equality` only where they have less."""
    missing = (target - entropy(std)) / std.shape[-1]
    return std * jnp.exp(missing if is_equality else jnp.maximum(missing, 0.0))[..., None]


def linear(initial: Bound, target: Bound, progress: Bound, temperature: Bound) -> Bound:
    """Entropy on the line from `initial` to `target`."""
    del temperature
    return initial + progress * (target - initial)


def exponential(initial: Bound, target: Bound, progress: Bound, temperature: Bound) -> Bound:
    """Entropy that approaches `target` by a factor of `temperature` in every tenth of the progress."""
    return target + (initial - target) * temperature ** (10.0 * progress)


ENTROPY_SCHEDULES = {"linear": linear, "exponential": exponential}
