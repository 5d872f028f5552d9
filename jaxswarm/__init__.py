"""Train cooperative swarms with deep reinforcement learning, as one compiled JAX program."""

from typing import TYPE_CHECKING, Any

from etils import epy

with epy.lazy_api_imports(globals()):  # the command line answers before JAX is there
    from jaxswarm.aggregators import AGGREGATORS
    from jaxswarm.host.divergence import replay_update
    from jaxswarm.host.fit import fit
    from jaxswarm.host.trained import load
    from jaxswarm.learners import LEARNERS
    from jaxswarm.networks import ActorCritic
    from jaxswarm.tasks import TASKS
    from jaxswarm.training import Experiment, TrainState, evaluate, init, train

if TYPE_CHECKING:
    from jaxswarm.tasks import Assembly, Clustering, Pursuit, Rendezvous

__version__ = "0.2.0.dev0"

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
    "replay_update",
    "train",
]


def experiment(*overrides: str) -> "Experiment":
    """Build the `Experiment` of these overrides of `jaxswarm-train`; raises a `ConfigError` for invalid overrides.

    experiment = jaxswarm.experiment("experiment=pursuit_best", "task.num_agents=20")
    """
    from jaxswarm import config  # noqa: PLC0415

    return config.build(config.compose(overrides))


def make(name: str, **fields: Any) -> "Assembly | Clustering | Pursuit | Rendezvous":
    """Build the task of this name: a registered class, or a preset of `jaxswarm-train task=NAME` with other fields.

    The annotation lists the tasks of this package; a task that you register is built as well. Raises a `ValueError`
    for an unknown name and for impossible values of fields.
    """
    from jaxswarm.config import groups  # noqa: PLC0415
    from jaxswarm.tasks import TASKS  # noqa: PLC0415

    if name in TASKS:
        return TASKS[name](**fields)
    presets = groups.choices()["task"]
    if name not in presets:
        raise groups.unknown_choice("task", name, list(dict.fromkeys([*TASKS, *presets])))
    fields = groups.preset("task", name) | fields
    return TASKS[fields.pop("name")](**fields)
