"""Speed of every aggregator in every layout; prints one JSON line per combination.

    python benchmarks/aggregation.py [aggregators=mean,max] [rows=4000] [slots=19] [features=64] [repeats=5] [out=FILE]

A network encodes the 8 features of each entity (one layer), aggregates, and decodes (one layer). Times are minima over
the repeats, for the output and for the output with its gradient with respect to all parameters. All combinations of one
size take turns within a repeat, so that their ratios do not depend on the load of the machine. The product of two
2048 x 2048 matrices takes part, too; its speed shows what the machine can reach at that time. Training uses the layout
"chosen"; the others are forced.
"""

import itertools
import sys
import time

import jax
import jax.numpy as jnp
from flax import linen as nn
from timing import report, settings

from jaxswarm import AGGREGATORS
from jaxswarm.aggregators import sets
from jaxswarm.host import ensemble
from jaxswarm.networks import Encoder, ParallelEncoders
from jaxswarm.types import Entities

GRID = {
    "aggregators": ",".join(AGGREGATORS),
    "rows": "256,1000,4000,16000",
    "slots": "5,19,49",
    "features": "64,120",
}
OWN, DIM = 3, 8


class Network(nn.Module):
    aggregator: nn.Module
    width: int
    layout: str | None

    @nn.compact
    def __call__(self, own, group):
        has_encoder = self.aggregator.num_encoders > 0
        encoder = (
            Encoder((self.width,), "leaky_relu", self.aggregator.num_parts) if has_encoder else ParallelEncoders(())
        )
        aggregator = self.aggregator.copy(name="pooling")
        pool = sets.Pool(aggregator, (encoder,), self.width if has_encoder else DIM, self.layout)
        return nn.leaky_relu(nn.Dense(self.width)(jnp.concatenate([own, pool((group,), own)], -1)))


def programs(name, layout, rows, slots, width):
    """Return calls of the compiled output, and of the compiled output with its gradient."""
    model = Network(AGGREGATORS[name](), width, layout)
    keys = jax.random.split(jax.random.key(0), 3)
    group = Entities(jax.random.normal(keys[0], (rows, slots, DIM)), jnp.ones((rows, slots), bool))
    own = jax.random.normal(keys[1], (rows, OWN))
    params = jax.jit(model.init)(keys[2], own[:1], jax.tree.map(lambda x: x[:1], group))
    forward = (
        jax.jit(lambda p, o, g: model.apply(p, o, g).sum())
        .lower(params, own, group)
        .compile(ensemble.compiler_options())
    )
    gradient = jax.jit(jax.value_and_grad(lambda p, o, g: model.apply(p, o, g).sum()))
    gradient = gradient.lower(params, own, group).compile(ensemble.compiler_options())
    return {"forward": lambda: forward(params, own, group), "gradient": lambda: gradient(params, own, group)}


def minima(calls, repeats):
    """Return the least seconds of each call, after a warm-up; a call below 20 ms is repeated within its turn."""
    best = {}
    for repeat, (name, call) in itertools.product(range(repeats + 1), calls.items()):
        for _ in range(1 + int(0.02 / best.get(name, 1.0))):
            start = time.perf_counter()
            jax.block_until_ready(call())
            seconds = time.perf_counter() - start
            best[name] = min(best[name], seconds) if repeat > 0 and name in best else seconds
    return best


def measure(names, rows, slots, width, repeats):
    """Yield the results of all aggregators and layouts at one size."""
    matrix = jax.random.normal(jax.random.key(3), (2048, 2048))
    product = jax.jit(lambda x: x @ x)
    calls = {("gemm", "", ""): lambda: product(matrix)}
    for name in names:
        is_monoid = isinstance(AGGREGATORS[name](), sets.Monoid)
        for layout in ("chosen", "streaming", "dense", "segments") if is_monoid else ("chosen", "segments"):
            forced = None if layout == "chosen" else layout
            for kind, call in programs(name, forced, rows, slots, width).items():
                calls[name, layout, kind] = call
    best = minima(calls, repeats)
    gemm = 2 * 2048**3 / best.pop(("gemm", "", ""))
    for name, layout in dict.fromkeys((name, layout) for name, layout, _ in best):
        forward, gradient = (best[name, layout, kind] for kind in ("forward", "gradient"))
        yield {
            "benchmark": "aggregation",
            "aggregator": name,
            "layout": layout,
            "rows": rows,
            "slots": slots,
            "features": width,
            "forward_seconds": forward,
            "gradient_seconds": gradient,
            "gradient_rows_per_second": rows / gradient,
            "gemm_gflops": gemm / 1e9,
        }


def main(overrides):
    given = settings(overrides, **GRID, repeats="5")
    sizes = ([int(x) for x in given[name].split(",")] for name in ("rows", "slots", "features"))
    for size in itertools.product(*sizes):
        for result in measure(given["aggregators"].split(","), *size, int(given["repeats"])):
            report(result, given["out"])


if __name__ == "__main__":
    main(sys.argv[1:])
