"""PPO reproduces the recorded updates of the original trainer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from golden_weights import cases, network, observation, params, weights

from jaxswarm.learners import on_policy
from jaxswarm.learners.on_policy import Minibatch
from jaxswarm.learners.ppo import PPO

AGGREGATION = {
    "mean": {"type": "Mean", "actual_mode": "mean"},
    "max": {"type": "Mean", "actual_mode": "max"},
    "bayes": {
        "type": "Bayesian",
        "learnable_mu_z_0": "one_per_dim",
        "learnable_sigma_z_0": "one_per_dim",
        "variance_rectifier": "softplus",
        "output_variance": False,
    },
}


def complete(meta):
    """Add the settings that all recorded updates share, which the recording omits."""
    layout = meta["layout"] | {"order": ["local", "aggregatables"]}
    common = {"agg_mode": AGGREGATION[meta["agg"]], "agg_into_space": "separate", "out_hidden": []}
    return meta | common | {"layout": layout}


by_case = pytest.mark.parametrize(
    ("meta", "arrays"),
    [
        pytest.param(complete(meta), arrays, id=meta["agg"], marks=pytest.mark.slow if meta["agg"] == "max" else ())
        for meta, arrays in cases("ppo.npz")
    ],
)


def recorded_advantages(meta, arrays):
    """Return advantages from the recorded values.

    The original stores whether an observation is the first of its episode.
    """
    is_done = np.concatenate([arrays["episode_start"][1:], arrays["last_done"][None]]).astype(bool)
    next_value = np.concatenate([arrays["values"][1:], arrays["last_values"][None]])
    # In the original, every agent is an environment of its own.
    value, next_value = arrays["values"][..., None], next_value[..., None]
    steps = [jnp.asarray(x) for x in (arrays["rewards"], is_done, is_done, value, next_value)]
    return on_policy.generalized_advantages(*steps, meta["gamma"], meta["gae_lambda"])[..., 0]


@by_case
def test_recorded_advantages(meta, arrays):
    advantage = recorded_advantages(meta, arrays)
    np.testing.assert_allclose(advantage, arrays["advantages"], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(advantage + arrays["values"], arrays["returns"], rtol=1e-5, atol=1e-4)


@by_case
def test_recorded_update(meta, arrays):
    learner = PPO(
        learning_rate=meta["learning_rate"],
        clip_range=meta["clip_range"],
        value_coefficient=meta["vf_coef"],
        entropy_coefficient=meta["ent_coef"],
        max_grad_norm=meta["max_grad_norm"],
        adam_epsilon=meta["adam_eps"],
        num_epochs=meta["n_epochs"],
        batch_size=meta["batch_size"],
    )
    model = network(meta)
    before, after = (params(meta, weights(arrays, f"{w}/")) for w in ("w0", "w1"))

    def flat(x):
        return jnp.asarray(x).reshape(-1, *x.shape[2:])

    obs = jax.tree.map(flat, observation(meta, arrays["obs"]))
    batch = Minibatch(obs, *[flat(arrays[name]) for name in ("actions", "log_probs", "advantages", "returns")])

    @jax.jit
    def update(state):
        loss = lambda params, batch: learner.loss(model, params, batch)  # noqa: E731
        fetch = lambda order: jax.tree.map(lambda x: x[order], batch)  # noqa: E731
        optimizer = on_policy.adam(learner)
        return on_policy.descend(
            jax.random.key(0), loss, fetch, optimizer, state, meta["batch_size"], 1, meta["n_epochs"]
        )

    state, metrics = update(learner.init(before))
    moved, deviation = (
        np.concatenate([np.abs(a - b).reshape(-1) for a, b in zip(*map(jax.tree.leaves, trees), strict=True)])
        for trees in ((before, after), (state.params, after))
    )
    assert moved.max() > 2e-4
    assert deviation.max() < 1e-5 * meta["n_epochs"]
    logged = meta["logged"]
    assert float(metrics["value_loss"]) == pytest.approx(logged["train/value_loss"], rel=1e-4)
    assert float(metrics["policy_loss"]) == pytest.approx(logged["train/policy_gradient_loss"], abs=1e-5)
    assert float(metrics["entropy"]) == pytest.approx(-logged["train/entropy_loss"], rel=1e-5)
    if meta["n_epochs"] == 1:  # the original logs the last epoch only
        assert float(metrics["approx_kl"]) == pytest.approx(logged["train/approx_kl"], abs=1e-6)
    explained = on_policy.explained_variance(jnp.asarray(arrays["values"]), jnp.asarray(arrays["returns"]), None)
    assert float(explained) == pytest.approx(logged["train/explained_variance"], abs=1e-3)
