"""How long several seeds take side by side, over one seed, and how much memory; one JSON line for each number of seeds.

    python benchmarks/seeds.py [seeds=1,4,16,64] [width=N] [updates=3] [out=FILE] [group=choice | key=value] ...

The other words describe the experiment as for jaxswarm-train. Every number of seeds has a process of its own, so that
peak memory is its own, too; times are minima over the updates. `width` seeds are trained at a time, the rest after
them; the default is that of training. The cores of a CPU are as many devices, unless XLA_FLAGS says how many:
XLA_FLAGS=--xla_force_host_platform_device_count=1.
"""

import json
import subprocess
import sys
import time

import jax
import numpy as np
from jaxswarm.cli.overrides import split, use_compile_cache
from timing import peak_memory, report

from jaxswarm import config
from jaxswarm.host import ensemble


def measure(num_seeds, num_updates, overrides):
    """Seconds per update of all seeds, and of compiling."""
    experiment = config.build(config.compose(overrides))
    batch = ensemble.make_batch([experiment], num_seeds)
    states = ensemble.init_batch(batch, range(num_seeds))
    start, best = time.perf_counter(), float("inf")
    program = ensemble.compile_batch(batch, states, 1, print)
    for update in range(num_updates + 1):
        states, _ = jax.block_until_ready(program(batch.experiments, states, np.int32(1)))
        now = time.perf_counter()
        if update == 0:  # compiles, and evaluates
            first = now - start
        else:
            best = min(best, now - start)
        start = now
    return {
        "num_seeds": num_seeds,
        "mesh": None if batch.mesh is None else dict(batch.mesh.shape),
        "seconds_per_update": best,
        "agent_steps_per_second": num_seeds * experiment.agent_steps_per_update / best,
        "first_update_seconds": first,
        "peak_memory_mib": peak_memory(),
    }


def main(overrides):
    options, overrides = split(overrides, ("seeds", "width", "updates", "out", "only"))
    num_updates = int(options.get("updates", 3))
    if "width" in options:
        ensemble.CPU_WIDTH = int(options["width"])
    if "only" in options:
        use_compile_cache()
        ensemble.use_cores(int(options["only"]))
        print(json.dumps(measure(int(options["only"]), num_updates, overrides) | {"width": ensemble.CPU_WIDTH}))
        return
    of_one = None
    for num_seeds in options.get("seeds", "1,4,16,64").split(","):
        given = [f"{name}={options[name]}" for name in ("width", "updates") if name in options]
        command = [sys.executable, __file__, f"only={num_seeds}", *given, *overrides]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        result = {"benchmark": "seeds", "words": overrides} | json.loads(output.splitlines()[-1])
        of_one = of_one or result["seconds_per_update"] / result["num_seeds"]
        result["over_one_seed"] = result["seconds_per_update"] / of_one
        report(result, options.get("out", ""))


if __name__ == "__main__":
    main(sys.argv[1:])
