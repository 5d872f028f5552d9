"""TRL reproduces recorded losses, controls the entropy and refuses bad input."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import NETWORK, OPTIONS, PROBES, SIZES, policy_and_value
from test_projections import META, NUM_ROWS, arrays, cov_distance, mean_distance, recorded_inputs

import jaxswarm
from jaxswarm import LEARNERS, Experiment
from jaxswarm.distributions import gaussian_with_std
from jaxswarm.learners import on_policy
from jaxswarm.learners.on_policy import Minibatch
from jaxswarm.learners.trl import TRL
from jaxswarm.types import Observation

BOUNDS = {"mean_bound": 0.03, "cov_bound": 0.001}  # the defaults
NO_TARGET = jnp.zeros(())


class Outputs:
    """Network whose outputs are its parameters."""

    def __init__(self, std):
        self.std = std

    def apply(self, params, obs):
        del obs
        return gaussian_with_std(params["mean"], params["std"]), jnp.zeros(len(params["mean"]))


@partial(jax.jit, static_argnums=1)
def loss_and_gradient(learner, std, params, batch, entropy_bound=NO_TARGET):
    """Return loss, metrics and gradient without standardized advantages, as in the recorded losses."""

    def loss(params):
        return learner.loss(Outputs(std), params, batch, entropy_bound)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(on_policy, "standardized", lambda advantage, mask: advantage)
        (total, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(params)
    return total, metrics, gradient


def recorded_batch(meta):
    """Return the outputs of a network and a batch for it, padded to shapes that suit all dimensions."""
    recorded = arrays(meta)
    (mean, std, old_mean, old_std, mean_bound, cov_bound), _ = recorded_inputs(meta, recorded, jnp.float32)
    action = jnp.pad(jnp.asarray(recorded["act"]), ((0, 0), (0, mean.shape[1] - meta["dim"])))
    log_prob = gaussian_with_std(old_mean, old_std).log_prob(action)
    obs = Observation(jnp.zeros((NUM_ROWS, 0)), {})
    batch = Minibatch(obs, action, log_prob, jnp.asarray(recorded["adv"]), jnp.zeros(NUM_ROWS), old_mean, old_std)
    params = {"mean": mean, "std": std[:1] if meta["is_shared"] else std}
    return recorded, params, batch, {"mean_bound": mean_bound, "cov_bound": cov_bound}


def recorded_losses(meta, coefficient, objective="projected"):
    recorded, params, batch, bounds = recorded_batch(meta)
    learner = TRL(
        projection=meta["projection"], objective=objective, regression_coefficient=jnp.float32(coefficient), **bounds
    )
    total, metrics, gradient = loss_and_gradient(learner, "shared" if meta["is_shared"] else "state", params, batch)
    assert float(total) == pytest.approx(float(metrics["policy_loss"] + metrics["regression_loss"]), rel=1e-6)
    return recorded, metrics, jax.tree.map(lambda x: np.asarray(x)[:, : meta["dim"]], gradient)


def relative_error(x, expected):
    return np.linalg.norm(x - expected) / np.linalg.norm(expected)


KINDS = ("kl", "wasserstein", "frobenius")
CASES = [m for m in META["cases"] if m["projection"] in KINDS and m["regime"] in ("slight", "outside")]
by_case = pytest.mark.parametrize("meta", CASES, ids=[f"{m['projection']}-{m['dim']}" for m in CASES])


@by_case
def test_recorded_surrogate(meta):
    recorded, metrics, gradient = recorded_losses(meta, 0.0)
    assert float(metrics["policy_loss"]) == pytest.approx(float(recorded["surr"]), rel=1e-4, abs=1e-5)
    assert relative_error(gradient["mean"], recorded["g_surr_mean"]) < 1e-4
    assert relative_error(gradient["std"], recorded["g_surr_std"]) < 3e-4


@by_case
def test_recorded_regression_loss(meta):
    recorded, metrics, gradient = recorded_losses(meta, meta["coefficient"])
    if meta["projection"] != "frobenius":  # whose recorded gradients also flow into the goal
        assert relative_error(gradient["mean"], recorded["g_surr_mean"] + recorded["g_tr_mean"]) < 1e-4
        assert relative_error(gradient["std"], recorded["g_surr_std"] + recorded["g_tr_std"]) < 1e-3
    elif not meta["is_shared"]:  # the recorded loss uses the standard deviation instead of the variance
        std, goal = recorded["std"], recorded["proj_std"]
        other = np.square(std - goal).sum(-1) - np.square(std**2 - goal**2).sum(-1)
        recorded["tr_loss"] = recorded["tr_loss"] - meta["coefficient"] * other.mean()
    assert float(metrics["regression_loss"]) == pytest.approx(float(recorded["tr_loss"]), rel=1e-4)


def test_the_raw_objective_is_the_policy_gradient_of_the_network_itself():
    meta = next(meta for meta in CASES if meta["projection"] == "wasserstein" and meta["is_shared"])
    recorded, params, batch, _ = recorded_batch(meta)
    _, metrics, gradient = recorded_losses(meta, 0.0, "raw")

    def surrogate(params):
        log_prob = jax.scipy.stats.norm.logpdf(batch.action, params["mean"], params["std"]).sum(-1)
        return -(jnp.exp(log_prob - batch.log_prob) * batch.advantage).mean()

    expected, expected_gradient = jax.value_and_grad(surrogate)(params)
    assert float(metrics["policy_loss"]) == pytest.approx(float(expected), rel=1e-4)
    for name in params:
        assert relative_error(gradient[name], expected_gradient[name][:, : meta["dim"]]) < 1e-4
    _, metrics, _ = recorded_losses(meta, meta["coefficient"], "raw")
    assert float(metrics["regression_loss"]) == pytest.approx(float(recorded["tr_loss"]), rel=1e-4)


def test_metrics_are_of_the_network_itself_against_the_policy_that_acted():
    meta = next(meta for meta in CASES if meta["projection"] == "kl" and not meta["is_shared"])
    recorded, metrics, _ = recorded_losses(meta, meta["coefficient"])
    mean_part = mean_distance("kl", *(recorded[name] for name in ("mean", "old_mean", "old_std")))
    cov_part = cov_distance("kl", recorded["std"], recorded["old_std"])
    expected = {
        "mean_part": mean_part.mean(),
        "mean_part_max": mean_part.max(),
        "cov_part": cov_part.mean(),
        "cov_part_max": cov_part.max(),
        "projected_fraction": ((mean_part > meta["mean_bound"]) | (cov_part > meta["cov_bound"])).mean(),
    }
    assert {name: float(metrics[name]) for name in expected} == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("control", ["inequality", "equality"])
def test_entropy_control_scales_the_projected_policy(control):
    meta = next(meta for meta in CASES if meta["projection"] == "wasserstein" and meta["is_shared"])
    _, params, batch, bounds = recorded_batch(meta)

    def entropy(target, control):
        learner = TRL(entropy_control=control, **bounds)
        return float(loss_and_gradient(learner, "shared", params, batch, jnp.asarray(target))[1]["entropy"])

    free = entropy(0.0, "none")
    assert entropy(free + 2.0, control) == pytest.approx(free + 2.0, rel=1e-5)
    assert entropy(free - 2.0, control) == pytest.approx(free - (2.0 if control == "equality" else 0.0), rel=1e-5)


def test_the_schedule_of_the_entropy_starts_with_the_first_update_and_ends():
    learner = TRL(entropy_schedule="linear", target_entropy=-1.0, entropy_updates=10.0)
    state = learner.init({}).replace(initial_entropy=jnp.asarray(3.0))
    entropies = [float(learner.scheduled_entropy(state.replace(num_updates=jnp.asarray(n)))) for n in (1, 5, 10, 99)]
    assert entropies == pytest.approx([2.6, 1.0, -1.0, -1.0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "trl"])
def test_a_standard_deviation_that_depends_on_the_state_is_learned(name):
    task = PROBES["reward that depends on both"]
    learner = LEARNERS[name](**OPTIONS)
    experiment = Experiment(task, NETWORK.clone(std="state"), learner, **SIZES)
    _, metrics = jaxswarm.train(experiment, jaxswarm.init(experiment, jax.random.key(0)), 41)
    returns = metrics["eval/return"][::20]
    assert returns[2] > returns[0] / 2  # both returns are negative
    assert metrics["learner/entropy"][-1] < metrics["learner/entropy"][0]


@pytest.mark.slow
def test_the_entropy_of_the_policy_follows_its_schedule():
    options = {"entropy_control": "equality", "target_entropy": 0.5, "entropy_updates": 4.0}
    experiment = Experiment(PROBES["constant reward"], NETWORK, TRL(**OPTIONS, **options), **SIZES)
    state = jaxswarm.init(experiment, jax.random.key(0))
    initial = 0.5 * np.log(2 * np.pi * np.e)  # entropy of a standard deviation of 1
    for progress in (0.25, 0.5, 0.75, 1.0, 1.0):
        state, _ = jaxswarm.train(experiment, state, 1)
        policy, _ = policy_and_value(state.learner.params, 1, 0)
        assert float(policy.entropy()) == pytest.approx(initial + progress * (0.5 - initial), abs=1e-4)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("projection", "frob"),
        ("objective", "clipped"),
        ("mean_bound", 0.0),
        ("cov_bound", -1.0),
        ("regression_coefficient", 0.0),
        ("entropy_control", True),
        ("entropy_schedule", "cosine"),
        ("entropy_updates", 0.0),
        ("entropy_temperature", 1.0),
    ],
)
def test_impossible_numbers_are_named(field, value):
    with pytest.raises(ValueError, match=rf"{field}: must be \w.*, got {value!r}"):
        TRL(**{field: value})


def test_the_entropy_of_a_policy_that_is_never_projected_cannot_be_controlled():
    with pytest.raises(ValueError, match=r"entropy_control: must be none with objective='raw', .* got 'equality'"):
        TRL(objective="raw", entropy_control="equality")


def test_bounds_and_coefficient_can_be_swept():
    leaves = jax.tree.leaves(TRL(mean_bound=0.1, cov_bound=0.2, regression_coefficient=0.3))
    assert {0.1, 0.2, 0.3} <= set(leaves)
