"""Projections match recorded ones and are correct for random policies; distances are reimplemented in float64."""

import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxswarm.distributions import gaussian_with_std
from jaxswarm.learners.projections import ENTROPY_SCHEDULES, PROJECTIONS, control_entropy, entropy

ARCHIVE = np.load(Path(__file__).parent / "golden" / "projections.npz")
META = json.loads(str(ARCHIVE["meta_json"]))
RECORDED = [meta for meta in META["cases"] if meta["projection"] != "entropy"]
NUM_ROWS, MAX_DIM = 64, 8

every_kind = pytest.mark.parametrize("name", PROJECTIONS)


def arrays(meta):
    prefix = f"c{meta['case']:03d}_"
    return {key.removeprefix(prefix): ARCHIVE[key] for key in ARCHIVE.files if key.startswith(prefix)}


def mean_distance(name, mean, old_mean, old_std):
    scale = 1.0 if name.endswith("unscaled") else old_std
    return ((mean - old_mean) ** 2 / scale**2).sum(-1) * (0.5 if name == "kl" else 1.0)


def cov_distance(name, std, old_std):
    kind = {
        "kl": lambda: 0.5 * (std**2 / old_std**2 - 1 - 2 * np.log(std / old_std)),
        "wasserstein": lambda: (std / old_std - 1) ** 2,
        "wasserstein_unscaled": lambda: (std - old_std) ** 2,
        "frobenius": lambda: (std**2 - old_std**2) ** 2,
        "frobenius_unscaled": lambda: (std**2 - old_std**2) ** 2,
    }
    return kind[name]().sum(-1)


def project(name, mean, std, old_mean, old_std, mean_bound, cov_bound):
    old = gaussian_with_std(old_mean, old_std)
    policy = PROJECTIONS[name](gaussian_with_std(mean, std), old, mean_bound, cov_bound)
    return policy.mean(), policy.stddev()


def project_and_pull_back(name, *arguments, weights):
    """Return the projection and the gradient of the weighted sum of its entries."""
    return jax.tree.map(np.asarray, _project_and_pull_back(name, *arguments, weights))


@partial(jax.jit, static_argnums=0)
def _project_and_pull_back(name, mean, std, old_mean, old_std, mean_bound, cov_bound, weights):
    fixed = (old_mean, old_std, mean_bound, cov_bound)
    projected, pull_back = jax.vjp(lambda mean, std: project(name, mean, std, *fixed), mean, std)
    return projected, pull_back(weights)


def recorded_inputs(meta, recorded, dtype):
    """Return the arguments of `project`, one policy per row.

    Padding with dimensions that do not change lets one program serve all cases.
    """

    def padded(name, neutral):
        x = np.broadcast_to(recorded[name], (NUM_ROWS, meta["dim"]))
        return jnp.asarray(np.pad(x, ((0, 0), (0, MAX_DIM - meta["dim"])), constant_values=neutral), dtype)

    inputs = [padded(name, neutral) for name, neutral in (("mean", 0), ("std", 1), ("old_mean", 0), ("old_std", 1))]
    weights = padded("w_mean", 0), padded("w_std", 0)
    return [*inputs, *(jnp.asarray(meta[name], dtype) for name in ("mean_bound", "cov_bound"))], weights


def recorded_outputs(meta, recorded, outputs):
    """Return projection and gradient without padding; a shared standard deviation has one row and a summed gradient."""
    (mean, std), (mean_gradient, std_gradient) = jax.tree.map(lambda x: x[:, : meta["dim"]], outputs)
    if meta["is_shared"]:
        return mean, std[:1], mean_gradient, std_gradient.sum(0, keepdims=True)
    return mean, std, mean_gradient, std_gradient


def gradient_scale(meta, recorded):
    """Return the gradient norm per row of the standard deviation if the projection passed on the whole gradient."""
    scale = recorded["w_std"].astype(float)
    scale = scale.sum(0, keepdims=True) if meta["is_shared"] else scale
    return np.linalg.norm(scale * recorded["proj_std"] / recorded["std"], axis=-1, keepdims=True)


by_recording = pytest.mark.parametrize("meta", RECORDED, ids=[f"{m['projection']}-{m['dim']}" for m in RECORDED])


@by_recording
def test_recorded_projections_and_gradients(meta):
    recorded = arrays(meta)
    inputs, weights = recorded_inputs(meta, recorded, jnp.float32)
    outputs = project_and_pull_back(meta["projection"], *inputs, weights=weights)
    mean, std, mean_gradient, std_gradient = recorded_outputs(meta, recorded, outputs)
    np.testing.assert_allclose(std, recorded["proj_std"], rtol=1e-6 if meta["projection"] == "kl" else 1e-5)
    np.testing.assert_array_less(np.abs(mean - recorded["proj_mean"]) / recorded["old_std"], 1e-5)
    length = np.linalg.norm(recorded["g_lin_mean"], axis=-1, keepdims=True)
    np.testing.assert_array_less(np.abs(mean_gradient - recorded["g_lin_mean"]) / length, 1e-4)
    error = np.abs(std_gradient - recorded["g_lin_std"]) / gradient_scale(meta, recorded)
    np.testing.assert_array_less(error, 1e-5)


@pytest.mark.parametrize("meta", [meta for meta in RECORDED if meta["projection"] == "kl"], ids=lambda m: m["dim"])
def test_recorded_roots_in_double_precision(meta):
    recorded = arrays(meta)
    with jax.enable_x64(True):
        inputs, weights = recorded_inputs(meta, recorded, jnp.float64)
        outputs = project_and_pull_back(meta["projection"], *inputs, weights=weights)
    _, std, _, std_gradient = recorded_outputs(meta, recorded, outputs)
    np.testing.assert_allclose(std, recorded["proj_std"], rtol=1e-11)
    error = np.abs(std_gradient - recorded["g_lin_std"]) / gradient_scale(meta, recorded)
    np.testing.assert_array_less(error, 1e-9)


@pytest.mark.parametrize("bound", [2.0, 30.0])
def test_large_bounds_are_met_too(bound):
    rng = np.random.default_rng(5)
    with jax.enable_x64(True):
        old_std = jnp.exp(jnp.asarray(rng.normal(size=(500, 3))))
        std = old_std * jnp.exp(jnp.asarray(rng.choice([1.0, 4.0], (500, 1)) * rng.normal(size=(500, 3))))
        projected = PROJECTIONS["kl"].project_std(std, old_std, jnp.float64(bound))
    before, after = (cov_distance("kl", np.asarray(x), np.asarray(old_std)) for x in (std, projected))
    assert (before > bound).any()
    np.testing.assert_allclose(after, np.minimum(before, bound), rtol=1e-7)


def policies(least_std, largest_std, least_bound):
    """Generate arguments of `project` with standard deviations in this range; changes and bounds have any size."""

    def rows(seed, change, *bounds):
        rng = np.random.default_rng(seed)
        old_std = np.exp(rng.uniform(np.log(least_std), np.log(largest_std), (NUM_ROWS, 3)))
        std = np.clip(old_std * np.exp(change * rng.normal(size=old_std.shape)), least_std, largest_std)
        old_mean = old_std * rng.normal(size=old_std.shape)
        mean = old_mean + old_std * change * rng.normal(size=old_std.shape)
        return [np.asarray(x, np.float32) for x in (mean, std, old_mean, old_std, *bounds)]

    log_bound = st.floats(np.log10(least_bound), 0.3)
    return st.builds(
        lambda seed, log_change, *log_bounds: rows(seed, 10**log_change, *(10**x for x in log_bounds)),
        st.integers(0, 2**31 - 1),
        st.floats(-3, 1),
        log_bound,
        log_bound,
    )


def for_every_kind(arguments, **more):
    """Run a property test for every projection; each example has many rows, so few examples suffice."""
    return lambda test: every_kind(settings(max_examples=15, deadline=None)(given(arguments=arguments, **more)(test)))


ORDINARY = policies(0.2, 3.0, 1e-4)
EXTREME = policies(1e-4, 1e4, 1e-6)
WEIGHTS = tuple(np.random.default_rng(0).normal(size=(2, NUM_ROWS, 3)).astype(np.float32))


def parts(name, mean, std, old_mean, old_std):
    mean, std, old_mean, old_std = (np.asarray(x, np.float64) for x in (mean, std, old_mean, old_std))
    return mean_distance(name, mean, old_mean, old_std), cov_distance(name, std, old_std)


@for_every_kind(ORDINARY)
def test_projected_policies_are_within_the_bounds(name, arguments):
    *policies, mean_bound, cov_bound = arguments
    projected, _ = project_and_pull_back(name, *arguments, weights=WEIGHTS)
    mean_part, cov_part = parts(name, *projected, *policies[2:])
    assert mean_part.max() <= mean_bound * 1.002
    assert cov_part.max() <= cov_bound * 1.002


@for_every_kind(ORDINARY)
def test_what_is_within_a_bound_comes_back_bit_by_bit_and_the_rest_at_the_bound(name, arguments):
    *policies, mean_bound, cov_bound = arguments
    projected, gradient = project_and_pull_back(name, *arguments, weights=WEIGHTS)
    after = parts(name, *projected, *policies[2:])
    for i, (part, bound) in enumerate(zip(parts(name, *policies), (mean_bound, cov_bound), strict=True)):
        is_inside, is_outside = part < bound * 0.999, part > bound * 1.001
        np.testing.assert_array_equal(projected[i][is_inside], policies[i][is_inside])
        np.testing.assert_array_equal(gradient[i][is_inside], WEIGHTS[i][is_inside])
        np.testing.assert_allclose(after[i][is_outside], bound, rtol=2e-3)


@for_every_kind(ORDINARY)
def test_projecting_again_changes_nothing(name, arguments):
    once, _ = project_and_pull_back(name, *arguments, weights=WEIGHTS)
    twice, _ = project_and_pull_back(name, *once, *arguments[2:], weights=WEIGHTS)
    for a, b in zip(once, twice, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


@for_every_kind(ORDINARY, order=st.permutations(range(3)))
def test_dimensions_have_no_order(name, arguments, order):
    order = list(order)
    projected, _ = project_and_pull_back(name, *arguments, weights=WEIGHTS)
    arguments = [x[:, order] for x in arguments[:4]] + arguments[4:]
    permuted, _ = project_and_pull_back(name, *arguments, weights=WEIGHTS)
    for a, b in zip(projected, permuted, strict=True):
        np.testing.assert_allclose(a[:, order], b, rtol=1e-5, atol=1e-5)


@for_every_kind(EXTREME)
def test_no_policy_is_too_extreme(name, arguments):
    projected, gradient = project_and_pull_back(name, *arguments, weights=WEIGHTS)
    assert all(np.isfinite(x).all() for x in (*projected, *gradient))
    std, old_std = arguments[1], arguments[3]
    assert (projected[1] >= np.minimum(std, old_std) * 0.9999).all()
    assert (projected[1] <= np.maximum(std, old_std) * 1.0001).all()


@every_kind
def test_gradients_are_finite_differences(name):
    rng = np.random.default_rng(0)
    size, bounds, step = (NUM_ROWS, 3), (0.05, 0.02), 1e-6
    old_mean, old_std = np.zeros(size), np.exp(rng.normal(size=size))
    std = old_std * np.exp(rng.uniform(0.05, 1.0, (NUM_ROWS, 1)) * rng.normal(size=size))
    mean = rng.uniform(0.05, 2.0, (NUM_ROWS, 1)) * rng.normal(size=size)
    directions = rng.normal(size=(2, *size))

    @jax.jit
    def along(x):
        """Return the projection of policies on a line, and its derivative."""

        def at(x):
            moved = (jnp.asarray(a) + x * jnp.asarray(d) for a, d in zip((mean, std), directions, strict=True))
            return project(name, *moved, jnp.asarray(old_mean), jnp.asarray(old_std), *bounds)

        return jax.jvp(at, (x,), (jnp.ones_like(x),))

    with jax.enable_x64(True):
        (_, derivative), (above, _), (below, _) = (jax.tree.map(np.asarray, along(x)) for x in (0.0, step, -step))
    distances = parts(name, mean, std, old_mean, old_std)
    is_clear = [abs(part / bound - 1) > 1e-3 for part, bound in zip(distances, bounds, strict=True)]
    for d, a, b, rows in zip(derivative, above, below, is_clear, strict=True):
        np.testing.assert_allclose(d[rows], (a - b)[rows] / (2 * step), atol=1e-7)


@pytest.mark.parametrize("name", ["kl"])  # the only projection with more than elementwise formulas
def test_bounds_can_be_swept_inside_a_scan(name):
    rng = np.random.default_rng(1)
    mean, std, old_mean, old_std = (jnp.asarray(np.exp(rng.normal(size=(NUM_ROWS, 3))), jnp.float32) for _ in range(4))

    @jax.jit
    def sweep(bounds):
        one = lambda bound: project(name, mean, std, old_mean, old_std, bound, bound)  # noqa: E731
        return jax.lax.scan(lambda _, row: (None, jax.vmap(one)(row)), None, bounds)[1]

    swept = sweep(jnp.array([[1e-3, 1e-2], [1e-1, 1.0]]))
    for i, bound in np.ndenumerate([[1e-3, 1e-2], [1e-1, 1.0]]):
        arguments = (mean, std, old_mean, old_std, np.float32(bound), np.float32(bound))
        projected, _ = project_and_pull_back(name, *arguments, weights=WEIGHTS)
        for a, b in zip(swept, projected, strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-5)


@pytest.mark.parametrize("meta", [meta for meta in META["cases"] if meta["projection"] == "entropy"])
@pytest.mark.parametrize(("kind", "is_equality"), [("ineq", False), ("eq", True)])
def test_recorded_entropy_control(meta, kind, is_equality):
    recorded = {name: jnp.asarray(x) for name, x in arrays(meta).items()}
    control = partial(control_entropy, target=recorded["beta"], is_equality=is_equality)
    std, pull_back = jax.vjp(control, recorded["std"])
    np.testing.assert_allclose(std, recorded[f"{kind}_out"], rtol=1e-5)
    np.testing.assert_allclose(pull_back(recorded["w"])[0], recorded[f"{kind}_grad"], rtol=1e-4, atol=1e-4)
    if is_equality:
        np.testing.assert_allclose(entropy(std), recorded["beta"], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("meta", META["entropy_schedule"], ids=lambda m: f"{m['kind']}-{m['step']}")
def test_recorded_entropy_schedules(meta):
    is_linear = meta["kind"] == "linear"
    target = meta["target"] * (1 if is_linear else meta["dim"])  # the original exponential schedule is per dimension
    schedule = ENTROPY_SCHEDULES["linear" if is_linear else "exponential"]
    result = schedule(meta["h0"], target, meta["step"] / meta["total"], meta["temperature"])
    assert result == pytest.approx(meta["beta"], rel=1e-6)
