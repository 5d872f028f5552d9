"""Measure how fast a training setting compiles, steps and learns.

    python benchmarks/training_throughput.py [group=choice | key=value] ... [repeats=3] [threshold=X seeds=8] [out=FILE]

The benchmark prints one JSON object. It takes the overrides of jaxswarm-train, for example
`experiment=rendezvous_thesis aggregator=bayesian`. `gemm_fraction` is the ratio of two speeds in FLOP/s: the useful
matrix products of the update, over a product of two 2048 x 2048 float32 matrices timed in the same process. Recomputed
activations and operations other than matrix products do not count as useful.

With `threshold`, the benchmark also trains several seeds in one program to the end of the setting, as jaxswarm-train
does. `seconds_to_threshold` is the median time to a return of at least the threshold, over the seeds that reached it.
It includes compilation.
"""

import multiprocessing
import statistics
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import jax
import numpy as np
from timing import gemm_flops, help_if_asked, peak_memory, report, seconds

from jaxswarm import config, init, rollout, train
from jaxswarm.analysis import curves
from jaxswarm.cli.program import split
from jaxswarm.files import RETURN
from jaxswarm.host import ensemble
from jaxswarm.host.fit import fit
from jaxswarm.training import Experiment, evaluate


def useful_flops(experiment: Experiment, params: dict) -> int:
    """Return the FLOP of the matrix products in the forward and backward pass of one sample.

    Each weight counts once per use, in three products: forward, gradient of the weights, gradient of the inputs. The
    last one is not needed in the first layer.
    """
    task = experiment.task
    groups = jax.eval_shape(lambda: task.observe(task.reset(jax.random.key(0)))).groups
    total = 0
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        names = [key.key for key in path]
        if names[-1] != "kernel":
            continue
        inputs, outputs = leaf.shape
        group = next((groups[name.removesuffix("_encoder")] for name in names if name.endswith("_encoder")), None)
        uses = group.mask.shape[-1] if group else 1
        is_first = group is not None and inputs == group.features.shape[-1]
        total += 2 * inputs * outputs * uses * (2 if is_first else 3)
    return total


def time_to_return(overrides: list[str], threshold: float, num_seeds: int) -> dict[str, float]:
    """Train all seeds, and return how many reach the threshold, and when.

    This function must run in a process of its own, because it makes each core a device.
    """
    ensemble.use_cores(num_seeds)
    composed = config.compose(overrides)
    experiment = config.build(composed)
    num_updates = config.run_settings(composed).length(experiment.agent_steps_per_update)
    _, rows = fit(experiment, num_updates, num_seeds=num_seeds, progress=False)
    of_seeds = list(curves.from_rows(rows, "wall_seconds", RETURN)[0].values())
    times, is_reached = curves.times_to(of_seeds, threshold)
    found = {"num_seeds": num_seeds, "num_reached": int(is_reached.sum()), "seconds": rows[-1]["wall_seconds"]}
    return found | ({"seconds_to_threshold": float(np.median(times[is_reached]))} if is_reached.any() else {})


def main(overrides: list[str]) -> None:
    help_if_asked(overrides)
    options, overrides = split(overrides, ("repeats", "threshold", "seeds", "out"))
    repeats = int(options.get("repeats", 3))
    experiment = config.build(config.compose(overrides))
    state = jax.jit(init)(experiment, jax.random.key(0))

    start = time.perf_counter()
    lowered = train.lower(experiment, state, experiment.eval_every)
    trace_seconds = time.perf_counter() - start
    start = time.perf_counter()
    program = lowered.compile(ensemble.compiler_options())
    compile_seconds = time.perf_counter() - start

    @partial(jax.jit, compiler_options=ensemble.compiler_options())
    def collect(state):
        policy = partial(experiment.network.apply, state.learner.params, method="policy")
        sizes = experiment.num_steps, experiment.num_start_states
        return rollout.collect(jax.random.key(1), experiment.task, policy, state.envs, *sizes)

    @partial(jax.jit, compiler_options=ensemble.compiler_options())
    def update(state, trajectory):
        key = jax.random.key(2)
        return experiment.learner.update(key, state.learner, experiment.network, experiment.task, trajectory)

    gemm_before = gemm_flops()
    _, trajectory, _ = collect(state)
    rollout_seconds = seconds(collect, state, repeats=repeats)
    update_seconds = seconds(update, state, trajectory, repeats=repeats)
    evaluate_seconds = seconds(evaluate, experiment, state, repeats=repeats)
    loop_seconds = seconds(program, experiment, state, repeats=repeats)
    gemm = statistics.mean([gemm_before, gemm_flops()])

    steps = experiment.agent_steps_per_update
    flops = useful_flops(experiment, state.learner.params) * steps * experiment.learner.num_epochs / update_seconds
    result = {
        "benchmark": "training_throughput",
        "setting": overrides,
        "agent_steps_per_update": steps,
        "trace_seconds": trace_seconds,
        "compile_seconds": compile_seconds,
        "rollout_agent_steps_per_second": steps / rollout_seconds,
        "update_agent_steps_per_second": steps / update_seconds,
        "loop_agent_steps_per_second": steps * experiment.eval_every / loop_seconds,
        "updates_per_evaluation": experiment.eval_every,
        "evaluation_seconds": evaluate_seconds,
        "peak_memory_mib": peak_memory(),
        "gemm_gflops": gemm / 1e9,
        "gemm_fraction": flops / gemm,
    }
    if "threshold" in options:
        threshold, num_seeds = float(options["threshold"]), int(options.get("seeds", 8))
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            found = pool.submit(time_to_return, overrides, threshold, num_seeds).result()
        result["to_return"] = {"threshold": threshold, **found}
    report(result, options.get("out", ""))


if __name__ == "__main__":
    main(sys.argv[1:])
