"""Estimates of the memory and the time of a training or an evaluation, before anything is compiled.

All arrays are abstract, so an estimate takes no memory. It counts what every program must hold: the states of all runs,
and on each device the trajectory and the observations of one run. Temporary arrays come on top of it.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax

from jaxswarm.config import ConfigError
from jaxswarm.config.schema import shown
from jaxswarm.host.ensemble import free_memory, mesh_shape
from jaxswarm.learners.on_policy import DEFAULT_BATCH_SIZE, OnPolicy
from jaxswarm.training import Experiment

UNCHECKED = 32.0  # sizes whose product is at most this many times that of the defaults always fit
NUM_EPISODES = 20  # of an evaluation, by default
RATES = {"cpu": 5e10}  # multiplications and additions per second of a core; small networks reach a third of it
ACCELERATOR_RATE = 2e13
ELEMENT_COST = 10  # operations for each feature of an observation
SLOW_UPDATE, SLOW_RUN = 300.0, 3 * 86_400.0  # seconds; longer ones are reported
GIB = 2**30


class Size(NamedTuple):
    """A setting that determines the sizes of arrays, with its default."""

    key: str
    value: Any
    default: Any

    @property
    def ratio(self) -> float:
        """How many times the default it is; for a list, the ratio of the largest elements."""
        value, default = (max(x, default=1) if isinstance(x, tuple) else x for x in (self.value, self.default))
        return value / max(default, 1)


class Shapes(NamedTuple):
    """Abstract arrays of one environment and of the network."""

    state: Any
    obs: Any
    params: Any


def check_training(
    experiment: Experiment, num_seeds: int, num_updates: int = 1, warn: Callable[[str], Any] | None = None
) -> None:
    """Raise a `ConfigError` if the training of these seeds cannot fit into memory.

    Calls `warn` with one line if it fits, but will be slow. Must be called after `ensemble.use_cores`.
    """
    sizes = training_sizes(experiment, num_seeds)
    if _is_small(sizes):
        return
    shapes = _shapes(sizes, experiment.task, experiment.network)
    num_devices = mesh_shape(num_seeds, experiment.num_envs, jax.local_device_count())
    of_all, of_one = training_memory(experiment, shapes, num_seeds)
    needed, free = of_all + num_devices[0] * of_one, free_memory() * math.prod(num_devices)
    if needed > free:
        raise _too_large(sizes, "training", needed, free)
    if warn is not None:
        seconds = update_seconds(experiment, shapes) * num_seeds / math.prod(num_devices)
        if seconds > SLOW_UPDATE or seconds * num_updates > SLOW_RUN:
            largest = max(sizes, key=lambda size: size.ratio)
            duration = f"{_duration(seconds)} per update, {_duration(seconds * num_updates)} in all"
            warn(f"warning: training will be slow, at least about {duration}; {largest.key} is {shown(largest.value)}")


def check_episodes(task: Any, episodes: int = 1) -> None:
    """Raise a `ConfigError` if simultaneous episodes of a task cannot fit into memory."""
    sizes = [Size("episodes", episodes, NUM_EPISODES), *_fields_of(task, "task.")]
    if _is_small(sizes):
        return
    shapes = _shapes(sizes, task, None)
    needed = episodes * (2 * _bytes(shapes.state) + _bytes(shapes.obs)) + _key_bytes(task.episode_length)
    if needed > free_memory():
        raise _too_large(sizes, "an evaluation", needed, free_memory())


def training_sizes(experiment: Experiment, num_seeds: int) -> list[Size]:
    """Return all settings of a training that determine sizes."""
    learner, network = experiment.learner, experiment.network
    sizes = [Size("num_seeds", num_seeds, 1), *_fields_of(experiment, "")]
    sizes += [Size("reset_pool", experiment.num_start_states, 1)] if experiment.reset_pool else []
    if isinstance(learner, OnPolicy) and learner.batch_size:
        sizes.append(Size("learner.batch_size", learner.batch_size, DEFAULT_BATCH_SIZE))
    for part, owner in {"task": experiment.task, "learner": learner, "network": network}.items():
        sizes += _fields_of(owner, f"{part}.")
    return sizes + _fields_of(getattr(network, "aggregator", None), "aggregator.")


def training_memory(experiment: Experiment, shapes: Shapes, num_seeds: int) -> tuple[float, float]:
    """Return the bytes of the states of all runs, and the bytes that the computation of one run adds."""
    num_envs, task = experiment.num_envs, experiment.task
    state, obs, params = (_bytes(x) for x in shapes)
    steps = num_envs * experiment.num_steps
    of_action = 4 * (3 * task.action_dim + 4) * task.num_agents
    trajectory = steps * (2 * state + of_action) + experiment.num_start_states * num_envs * state
    played = max(num_envs, experiment.num_eval_envs) * (state + obs)
    rows = (getattr(experiment.learner, "batch_size", None) or DEFAULT_BATCH_SIZE) / task.num_agents
    num_keys = max(experiment.num_steps, task.episode_length, getattr(experiment.learner, "num_epochs", 1))
    computed = trajectory + max(played, rows * obs) + params + _key_bytes(num_keys)
    return num_seeds * (3 * params + num_envs * state), computed


def update_seconds(experiment: Experiment, shapes: Shapes) -> float:
    """Return the least seconds of one update of one seed on one device, with its share of the evaluations."""
    network, num_epochs = experiment.network, getattr(experiment.learner, "num_epochs", 1)
    program = jax.make_jaxpr(network.apply)(shapes.params, shapes.obs).jaxpr
    elements = sum(math.prod(x.shape) for x in jax.tree.leaves(shapes.obs))
    of_step = 2 * _multiplications(program) + ELEMENT_COST * elements
    # An action and two values of each sample, and each epoch costs three times as much as a forward pass.
    passes = experiment.num_envs * experiment.num_steps * (3 + 3 * num_epochs)
    evaluated = experiment.num_eval_envs * experiment.task.episode_length / experiment.eval_every
    return of_step * (passes + evaluated) / RATES.get(jax.default_backend(), ACCELERATOR_RATE)


def _fields_of(owner: Any, prefix: str) -> list[Size]:
    """Return the fields of a dataclass that are sizes: integers and tuples of integers with a default."""
    fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    found = [Size(prefix + field.name, getattr(owner, field.name), field.default) for field in fields]
    return [size for size in found if _is_size(size.value) and _is_size(size.default)]


def _is_size(value: Any) -> bool:
    is_integer = isinstance(value, int) and not isinstance(value, bool)
    return is_integer or (isinstance(value, tuple) and all(type(x) is int for x in value))


def _is_small(sizes: list[Size]) -> bool:
    return math.prod(max(size.ratio, 1.0) for size in sizes) <= UNCHECKED


def _shapes(sizes: list[Size], task: Any, network: Any) -> Shapes:
    """Return the abstract arrays; raises a `ConfigError` if JAX cannot represent them."""

    try:
        return jax.eval_shape(_one_environment, task, network, jax.eval_shape(lambda: jax.random.key(0)))
    except (OverflowError, MemoryError) as error:
        raise _too_large(sizes, "one environment", math.inf, free_memory()) from error


@partial(jax.jit, static_argnames="network")  # so that it is traced once
def _one_environment(task: Any, network: Any, key: jax.Array) -> Shapes:
    state = task.reset(key)
    obs = task.observe(state)
    return Shapes(state, obs, network.init(key, obs) if network is not None else ())


def _too_large(sizes: list[Size], name: str, needed: float, free: float) -> ConfigError:
    """Return an error that names the setting that is farthest from its default."""
    largest = max(sizes, key=lambda size: size.ratio)
    memory = f"{name} needs at least {needed / GIB:,.1f} GiB, and {free / GIB:,.1f} GiB are available"
    return ConfigError(f"{largest.key}: must be small enough for the memory, got {shown(largest.value)}; {memory}")


def _bytes(tree: Any) -> float:
    return float(sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(tree)))


def _key_bytes(number: int) -> float:
    """Return the bytes of this number of random keys, one for each step of a loop."""
    return 8.0 * number


def _multiplications(program: Any) -> float:
    """Return the number of multiplications in the matrix products of a program."""
    total = 0.0
    for equation in program.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            shape = equation.invars[0].aval.shape
            total += math.prod(equation.outvars[0].aval.shape) * math.prod(shape[axis] for axis in contracted)
        values = [x if isinstance(x, tuple | list) else (x,) for x in equation.params.values()]
        inner = [getattr(x, "jaxpr", x) for several in values for x in several]
        calls = sum(_multiplications(x) for x in inner if hasattr(x, "eqns"))
        total += equation.params.get("length", 1) * calls if calls else 0.0
    return total


def _duration(seconds: float) -> str:
    for unit, length in {"days": 86_400, "hours": 3600, "minutes": 60}.items():
        if seconds >= 2 * length:
            return f"{seconds / length:,.0f} {unit}"
    return f"{seconds:,.0f} seconds"
