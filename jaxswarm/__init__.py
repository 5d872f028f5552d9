"""Train cooperative swarms with deep reinforcement learning, as one compiled JAX program."""

from typing import Any

from etils import epy

with epy.lazy_api_imports(globals()):  # the command line answers before JAX is there
    from jaxswarm.aggregators import AGGREGATORS
    from jaxswarm.host.fit import fit
    from jaxswarm.host.trained import load
    from jaxswarm.learners import LEARNERS
    from jaxswarm.networks import ActorCritic
    from jaxswarm.tasks import TASKS
    from jaxswarm.training import Experiment, TrainState, evaluate, init, train

__version__ = "0.1.0"

__all__ = [
    "AGGREGATORS",
    "LEARNERS",
    "TASKS",
    "ActorCritic",
    "Experiment",
    "TrainState",
    "evaluate",
    "experiment",
    "fit",
    "init",
    "load",
    "make",
    "train",
]


def experiment(*overrides: str) -> Any:
    """The `Experiment` that these words of `jaxswarm-train` ask for; a `ConfigError` says what is wrong with them.

    experiment = jaxswarm.experiment("experiment=pursuit_best", "task.num_agents=20")
    """
    from jaxswarm import config  # noqa: PLC0415

    return config.build(config.compose(overrides))


def make(name: str, **fields: Any) -> Any:
    """The task of that name, `TASKS[name](**fields)`; a `ValueError` names what there is."""
    from jaxswarm.tasks import TASKS  # noqa: PLC0415

    if name not in TASKS:
        raise ValueError(f"task: must be one of {', '.join(TASKS)}, got {name!r}")
    return TASKS[name](**fields)
