"""Many runs in a single compiled program: vectorized seeds and numeric hyperparameters, spread over all devices.

A batch of runs is an `Experiment` and a `TrainState` whose leaves have a leading runs axis. Each device trains its
share of the runs, `width` of them vectorized at a time. If there are more devices than runs, the environments of a run
are spread over several devices: the arithmetic is that of one device, and XLA sums gradients across devices.
"""

import contextlib
import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import psutil
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, UInt

from jaxswarm.rollout import ENVS_AXIS
from jaxswarm.training import Experiment, TrainState, evaluate, init, train_chunk
from jaxswarm.types import Metrics

RUNS_AXIS = "runs"
CPU_WIDTH = 1  # vectorized runs on a CPU, whose cache holds the activations of one; measured in benchmarks/LOG.md
COLLECTIVE_LIMITS = (
    "xla_cpu_collective_call_terminate_timeout_seconds",
    "xla_cpu_collective_call_warn_stuck_timeout_seconds",
)
MEMORY_SHARE = 0.9  # of the free memory that a program may use
LESS_MEMORY = "reduce num_envs, num_steps, num_seeds, num_eval_envs or learner.batch_size"

Program = Callable[
    [Experiment, TrainState, Any], tuple[TrainState, Metrics]
]  # the last argument is the number of updates


class RunBatch(NamedTuple):
    """Runs that are trained in one program."""

    experiments: Experiment  # leaves [runs]
    mesh: Mesh | None  # of devices; None: a single device

    @property
    def num_runs(self) -> int:
        """Number of runs, that is experiments times seeds."""
        return jax.tree.leaves(self.experiments)[0].shape[0]


def use_cores(num_runs: int) -> None:
    """Make each CPU core a device that trains its own runs; must be called before JAX uses any device.

    Two cores then train two runs in half the time of training them in sequence (benchmarks/LOG.md). This does nothing
    if devices are already in use, or if XLA_FLAGS or JAX_COORDINATOR_ADDRESS determine the devices. It also lets XLA
    wait for a core of a busy machine as long as necessary; otherwise XLA aborts the process after a minute.
    """
    _wait_for_cores()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    is_decided = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if not is_decided and "JAX_COORDINATOR_ADDRESS" not in os.environ:
        with contextlib.suppress(RuntimeError):  # devices are already in use
            jax.config.update("jax_num_cpu_devices", max(n for n in range(1, cores + 1) if num_runs % n == 0))


def _wait_for_cores() -> None:
    """Set XLA's time limits for collective operations to ten days, unless XLA_FLAGS determine them."""
    flags = os.environ.get("XLA_FLAGS", "")
    own = [f"--{name}={10 * 24 * 3600}" for name in COLLECTIVE_LIMITS if name not in flags]
    os.environ["XLA_FLAGS"] = " ".join([flags, *own]).strip()


def make_batch(experiments: Sequence[Experiment], num_seeds: int) -> RunBatch:
    """Combine `num_seeds` runs of each experiment, the seeds of the first experiment first.

    Raises a `ValueError` if the experiments differ in more than numeric (traced) hyperparameters.
    """
    leaves = [jax.tree.leaves(experiment) for experiment in experiments]
    structures = {jax.tree.structure(experiment) for experiment in experiments}
    if len(structures) > 1:
        raise ValueError("experiments of one program must differ in numeric (traced) hyperparameters only")
    stacked = [np.repeat(_stack(x), num_seeds, axis=0) for x in zip(*leaves, strict=True)]
    batch = jax.tree.unflatten(structures.pop(), stacked)
    return RunBatch(batch, make_mesh(len(experiments) * num_seeds, experiments[0].num_envs))


def _stack(numbers: Sequence[Any]) -> np.ndarray:
    """Stack one row per experiment, in JAX's own precision."""
    stacked = np.stack([np.asarray(x) for x in numbers])
    return stacked.astype(jax.dtypes.canonicalize_dtype(stacked.dtype))


def make_mesh(num_runs: int, num_envs: int) -> Mesh | None:
    """Return a mesh of as many devices as divide runs and environments, `None` for a single device.

    Raises a `ValueError` if several processes cannot use all of their devices.
    """
    num_devices = jax.device_count()
    runs, envs = mesh_shape(num_runs, num_envs, num_devices)
    if jax.process_count() > 1 and runs * envs < num_devices:
        raise ValueError(
            f"{num_runs} runs with {num_envs} environments cannot be spread over {num_devices} devices; "
            "the number of devices must divide the number of runs or of environments"
        )
    if runs * envs == 1:
        return None
    axes = (AxisType.Auto, AxisType.Auto)
    return jax.make_mesh((runs, envs), (RUNS_AXIS, ENVS_AXIS), axes, devices=jax.devices()[: runs * envs])


def mesh_shape(num_runs: int, num_envs: int, num_devices: int) -> tuple[int, int]:
    """Return how many devices share the runs, and how many share the environments of each run."""
    shapes = [
        (runs, math.gcd(num_envs, num_devices // runs)) for runs in range(1, num_devices + 1) if num_runs % runs == 0
    ]
    return max(shapes, key=lambda shape: (math.prod(shape), shape))


def abstract_state(experiment: Experiment, num_seeds: int = 1) -> TrainState:
    """Return shapes and dtypes of the states of `num_seeds` seeds, without computing them."""
    state = jax.eval_shape(init, experiment, jax.random.key(0))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_seeds, *x.shape), x.dtype), state)


def place(batch: RunBatch, states: TrainState) -> TrainState:
    """Move the states to the devices that compute the batch."""
    raw = jax.tree.map(lambda x: np.asarray(jax.random.key_data(x) if _is_key(x) else x), states)
    impls = jax.tree.map(lambda x: str(jax.random.key_impl(x)) if _is_key(x) else "", states)

    def wrapped(raw: Any) -> TrainState:
        return jax.tree.map(lambda x, impl: jax.random.wrap_key_data(x, impl=impl) if impl else x, raw, impls)

    return jax.jit(wrapped, out_shardings=_shardings(batch.mesh, states))(raw)


def init_batch(batch: RunBatch, seeds: Sequence[int]) -> TrainState:
    """Return the initial state of each run, bit for bit that of its seed alone."""
    seeds_array = np.asarray(seeds, np.uint32)
    shapes = jax.eval_shape(_start, batch.experiments, seeds_array)
    return jax.jit(_start, out_shardings=_shardings(batch.mesh, shapes))(batch.experiments, seeds_array)


def with_params(states: TrainState, params: Sequence[Any]) -> TrainState:
    """Replace the network parameters of each run's state."""
    given = jax.tree.map(lambda *x: np.stack([np.asarray(one) for one in x]), *params)
    placed = jax.tree.map(lambda new, old: jax.device_put(new, old.sharding), given, states.learner.params)
    return dataclasses.replace(states, learner=dataclasses.replace(states.learner, params=placed))


def _start(experiments: Experiment, seeds: UInt[Any, " runs"]) -> TrainState:
    return jax.lax.map(lambda run: init(run[0], jax.random.key(run[1])), (experiments, seeds))


def _shardings(mesh: Mesh | None, states: TrainState) -> Any:
    """Return the sharding of each leaf of the states; `None` for a single device."""
    if mesh is None:
        return None
    by_run, by_env = (NamedSharding(mesh, spec) for spec in (P(RUNS_AXIS), P(RUNS_AXIS, ENVS_AXIS)))
    spread = jax.tree.map(lambda _: by_run, states)
    return spread.replace(envs=jax.tree.map(lambda _: by_env, states.envs))


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def compile_batch(batch: RunBatch, states: TrainState, size: int, warn: Callable[[str], None]) -> Program:
    """Compile `train_chunk` for every run, with donated states and as many vectorized runs as fit into memory.

    Calls `warn` with one line if fewer runs fit than there are, or if not even one does.
    """
    num_local = batch.num_runs // (batch.mesh.shape[RUNS_AXIS] if batch.mesh else 1)
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return lambda experiments, states, num_updates: _advance(experiments, states, num_updates, size, 1, batch.mesh)
    width = num_local if jax.default_backend() != "cpu" else math.gcd(num_local, CPU_WIDTH)
    while True:
        with _on(batch):
            lowered = _advance.lower(batch.experiments, states, np.int32(0), size, width, batch.mesh)
            program = lowered.compile(compiler_options())
        needed, free = _memory(program), free_memory()
        if needed <= free:
            break
        sizes = f"{needed / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are free"
        if width == 1:
            warn(f"training needs {sizes}; {LESS_MEMORY}")
            break
        smaller = [n for n in range(1, width) if num_local % n == 0]
        width = max(n for n in smaller if n == 1 or n <= width * free / needed)
        warn(f"{num_local} vectorized runs need {sizes}; training {width} at a time")

    def run(experiments: Experiment, states: TrainState, num_updates: Any) -> tuple[TrainState, Metrics]:
        with jax.debug_nans(False):  # metrics that are not computed are NaN; training detects all others itself
            return program(experiments, states, np.int32(num_updates))

    return run


def compiler_options() -> dict[str, Any] | None:
    """Return XLA options: a CPU uses 512-bit vectors if it has them (measured in benchmarks/LOG.md)."""
    return {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else None


@partial(jax.jit, static_argnames=("size", "width", "mesh"), donate_argnames="states")
def _advance(
    experiments: Experiment, states: TrainState, num_updates: Array, size: int, width: int, mesh: Mesh | None
) -> tuple[TrainState, Metrics]:
    return _spread(mesh, partial(train_chunk, size=size), width)(experiments, states, num_updates)


def evaluate_batch(batch: RunBatch, states: TrainState) -> Metrics:
    """Evaluate the deterministic policy of every run; metrics [runs]."""
    with _on(batch), jax.debug_nans(False):
        return _evaluate(batch.experiments, states, batch.mesh)


@partial(jax.jit, static_argnames="mesh")
def _evaluate(experiments: Experiment, states: TrainState, mesh: Mesh | None) -> Metrics:
    return _spread(mesh, evaluate, 1)(experiments, states)


def fetch(batch: RunBatch, tree: Any) -> Any:
    """Gather the tree on this process's own device; all processes must make this call."""
    if jax.process_count() == 1 or batch.mesh is None:
        return tree
    everywhere = jax.jit(lambda x: x, out_shardings=NamedSharding(batch.mesh, P()))

    def local(x: Array) -> Array:  # one leaf at a time, because processes must communicate in the same order
        return jax.block_until_ready(everywhere(x)).addressable_data(0)

    return jax.tree.map(local, tree)


def broadcast_from_first(*values: int) -> list[int]:
    """Return the values of the first process in every process, so that all make the same decisions."""
    if jax.process_count() == 1:
        return list(values)
    from jax.experimental import multihost_utils  # noqa: PLC0415

    return [int(x) for x in multihost_utils.broadcast_one_to_all(np.array(values))]


def _on(batch: RunBatch) -> contextlib.AbstractContextManager:
    return contextlib.nullcontext() if batch.mesh is None else jax.set_mesh(batch.mesh)


def _spread(mesh: Mesh | None, function: Callable, width: int) -> Callable:
    """Map a function of one run, and of arguments common to all, over the runs; each device takes its own."""

    def local(experiments: Experiment, states: TrainState, *common: Array) -> Any:
        def one(run: tuple[Experiment, TrainState]) -> Any:
            return function(*run, *common)

        runs, num_local = (experiments, states), states.update.shape[0]
        if num_local == 1:  # without a loop, this is exactly the program of one run
            return jax.tree.map(lambda x: x[None], one(jax.tree.map(lambda x: x[0], runs)))
        if width == num_local:
            return jax.vmap(one)(runs)
        return jax.lax.map(one, runs, batch_size=None if width == 1 else width)

    if mesh is None:
        return local
    by_run = P(RUNS_AXIS)

    def spread(experiments: Experiment, states: TrainState, *common: Array) -> Any:
        specs = (by_run, by_run, *[P()] * len(common))
        return jax.shard_map(
            local, mesh=mesh, in_specs=specs, out_specs=by_run, axis_names={RUNS_AXIS}, check_vma=False
        )(experiments, states, *common)

    return spread


def _memory(program: Any) -> int:
    """Return the bytes that a device needs to run the program; 0 if unknown."""
    analysis = program.memory_analysis()
    if analysis is None:
        return 0
    sizes = analysis.argument_size_in_bytes + analysis.output_size_in_bytes + analysis.temp_size_in_bytes
    return sizes - analysis.alias_size_in_bytes


def _allotted(folder: Path = Path("/sys/fs/cgroup")) -> float:
    """Return the bytes that a container may still allocate, with its file cache as free; infinite without a limit."""
    places = (
        (folder, "memory.max", "memory.current"),
        (folder / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),  # cgroups v1
    )
    for place, limit, used in places:
        with contextlib.suppress(OSError, ValueError):  # no limit
            stat = dict(line.split() for line in (place / "memory.stat").read_text().splitlines())
            files = int(stat.get("inactive_file", stat.get("total_inactive_file", 0)))
            return float(int((place / limit).read_text()) - int((place / used).read_text()) + files)
    return math.inf


def free_memory() -> float:
    """Return the bytes that a program may use on each device; infinite if unknown."""
    if jax.default_backend() == "cpu":
        return MEMORY_SHARE * min(psutil.virtual_memory().available, _allotted()) / jax.local_device_count()
    stats = jax.local_devices()[0].memory_stats()
    return MEMORY_SHARE * (stats["bytes_limit"] - stats["bytes_in_use"]) if stats else math.inf
