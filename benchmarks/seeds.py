"""Measure time and memory of training several seeds in one program, compared with one seed.

    python benchmarks/seeds.py [seeds=1,4,16,64] [width=N] [updates=3] [out=FILE] [group=choice | key=value] ...

The benchmark prints one JSON object per line, for each number of seeds. The other arguments are overrides of
jaxswarm-train. Each number of seeds is measured in a process of its own, so its peak memory is its own, too. Times are
minima over the updates.

Each device trains `width` seeds at a time and the other seeds after them; the default is the width of jaxswarm-train.
Every core of a CPU is a device. Set XLA_FLAGS=--xla_force_host_platform_device_count=1 for another number of devices.
"""

import json
import subprocess
import sys
import time

import jax
import numpy as np
from timing import help_if_asked, peak_memory, report

from jaxswarm import config
from jaxswarm.cli.program import split, use_compile_cache
from jaxswarm.host import ensemble


def measure(num_seeds, num_updates, overrides):
    """Return the time per update of all seeds, the time of the first update (with compilation), and the memory."""
    experiment = config.build(config.compose(overrides))
    batch = ensemble.make_batch([experiment], num_seeds)
    states = ensemble.init_batch(batch, range(num_seeds))
    start, best = time.perf_counter(), float("inf")
    program = ensemble.compile_batch(batch, states, 1, print)
    for update in range(num_updates + 1):
        states, _ = jax.block_until_ready(program(batch.experiments, states, np.int32(1)))
        now = time.perf_counter()
        if update == 0:  # includes compilation and an evaluation
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
    help_if_asked(overrides)
    options, overrides = split(overrides, ("seeds", "width", "updates", "out", "only"))
    num_updates = int(options.get("updates", 3))
    if "width" in options:
        ensemble.CPU_WIDTH = int(options["width"])
    if "only" in options:
        use_compile_cache()
        ensemble.use_cores(int(options["only"]))
        print(json.dumps(measure(int(options["only"]), num_updates, overrides) | {"width": ensemble.CPU_WIDTH}))
        return
    one_seed = None
    for num_seeds in options.get("seeds", "1,4,16,64").split(","):
        given = [f"{name}={options[name]}" for name in ("width", "updates") if name in options]
        command = [sys.executable, __file__, f"only={num_seeds}", *given, *overrides]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        result = {"benchmark": "seeds", "overrides": overrides} | json.loads(output.splitlines()[-1])
        one_seed = one_seed or result["seconds_per_update"] / result["num_seeds"]
        result["over_one_seed"] = result["seconds_per_update"] / one_seed
        report(result, options.get("out", ""))


if __name__ == "__main__":
    main(sys.argv[1:])
