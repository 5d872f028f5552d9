"""Cost of trust region layers, measured in one process; prints one JSON object per line.

    python benchmarks/projections.py [rows=4096] [repeats=200] [out=FILE]

`call`: microseconds of projecting a batch, compared with its log-probability. `loss`: microseconds of loss and gradient
of TRL, compared with PPO on the same batch. The losses are measured for outputs that are parameters themselves, so that
nothing hides the cost of the layer, and for the default network on observations of rendezvous. Every line contains the
ratios.
"""

import sys
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from timing import report, settings

from jaxswarm import LEARNERS, config
from jaxswarm.distributions import gaussian
from jaxswarm.learners.on_policy import Minibatch
from jaxswarm.learners.projections import PROJECTIONS
from jaxswarm.types import Observation

BOUNDS = {"mean_bound": 0.03, "cov_bound": 0.001}


class Outputs:
    """Network whose outputs are its parameters."""

    def __init__(self, std):
        self.std = std

    def apply(self, params, obs):
        del obs
        return gaussian(params["mean"], params["log_std"]), params["value"]


def microseconds(functions: dict, repeats: int) -> dict[str, float]:
    """Return the median time of a call of each function; they take turns, so that all see the same machine load."""
    times = {name: [] for name in functions}
    for function, args in functions.values():
        jax.block_until_ready(function(*args))
    for _ in range(repeats):
        for name, (function, args) in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function(*args))
            times[name].append(time.perf_counter() - start)
    return {name: 1e6 * float(np.median(x)) for name, x in times.items()}


def changed(num_rows: int, dim: int, is_shared: bool) -> tuple[dict, dict, Minibatch]:
    """Return outputs, old outputs, and a batch sampled with the old ones; nearly all rows are outside the bounds."""
    keys = jax.random.split(jax.random.key(0), 7)
    stds = (1 if is_shared else num_rows, dim)
    old = {"mean": jax.random.normal(keys[0], (num_rows, dim)), "log_std": 0.3 * jax.random.normal(keys[1], stds)}
    new = {
        "mean": old["mean"] + 0.3 * jax.random.normal(keys[2], (num_rows, dim)),
        "log_std": old["log_std"] + 0.1 * jax.random.normal(keys[3], stds),
        "value": jnp.zeros(num_rows),
    }
    policy = gaussian(old["mean"], old["log_std"])
    action = policy.sample(seed=keys[4])
    advantage, target = jax.random.normal(keys[5], (2, num_rows))
    obs = Observation(jnp.zeros((num_rows, 0)), {})
    return new, old, Minibatch(obs, action, policy.log_prob(action), advantage, target, policy.mean(), policy.stddev())


def calls(num_rows: int, dim: int) -> dict:
    """Return the log-probability and the projections of state-dependent standard deviations, with arguments."""
    new, old, batch = changed(num_rows, dim, is_shared=False)

    def project(name, new, old):
        policies = (gaussian(x["mean"], x["log_std"]) for x in (new, old))
        policy = PROJECTIONS[name](*policies, *BOUNDS.values())
        return policy.mean(), policy.stddev()

    log_prob = jax.jit(lambda new: gaussian(new["mean"], new["log_std"]).log_prob(batch.action))
    functions = {name: (jax.jit(partial(project, name)), (new, old)) for name in PROJECTIONS}
    return {"log_prob": (log_prob, (new,))} | functions


def losses(network, params: dict, batch: Minibatch) -> dict:
    """Return loss and gradient of PPO, and of TRL with every projection, with arguments."""

    def function(learner, *more):
        gradient = jax.jit(jax.value_and_grad(lambda *args: learner.loss(network, *args, *more), has_aux=True))
        return gradient, (params, batch)

    trl = {name: function(LEARNERS["trl"](projection=name, **BOUNDS), jnp.zeros(())) for name in PROJECTIONS}
    return {"ppo": function(LEARNERS["ppo"]())} | trl


def on_rendezvous(num_rows: int, std: str) -> tuple:
    """Return the default network, its parameters, and a batch for it."""
    experiment = config.build(config.compose([f"network.std={std}"]))
    task, network = experiment.task, experiment.network
    keys = jax.random.split(jax.random.key(1), -(-num_rows // task.num_agents))
    obs = jax.vmap(task.observe)(jax.vmap(task.reset)(keys))
    obs = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:num_rows], obs)
    params = jax.jit(network.init)(jax.random.key(2), obs)
    _, _, batch = changed(num_rows, task.action_dim, is_shared=std == "shared")
    return network, params, batch.replace(obs=obs)


def main(overrides: list[str]) -> None:
    given = settings(overrides, rows="4096", repeats="200")
    num_rows, repeats = int(given["rows"]), int(given["repeats"])
    cases = [({"benchmark": "call", "dim": dim}, lambda dim=dim: calls(num_rows, dim)) for dim in (2, 8)]
    for std in ("shared", "state"):
        for dim in (2, 8):

            def outputs(std=std, dim=dim):
                new, _, batch = changed(num_rows, dim, is_shared=std == "shared")
                return losses(Outputs(std), new, batch)

            cases.append(({"benchmark": "loss", "of": "outputs", "std": std, "dim": dim}, outputs))
        network = {"benchmark": "loss", "of": "network", "std": std, "dim": 2}
        cases.append((network, lambda std=std: losses(*on_rendezvous(num_rows, std))))
    for case, functions in cases:
        times = microseconds(functions(), repeats)
        (reference, least), *others = times.items()
        result = {"rows": num_rows, reference: least}
        result |= {name: {"microseconds": t, f"of_{reference}": t / least} for name, t in others}
        report(case | result, given["out"])


if __name__ == "__main__":
    main(sys.argv[1:])
