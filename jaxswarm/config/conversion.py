"""Conversion of a config to an experiment and its run settings, and of an experiment to its config."""

import contextlib
import dataclasses
import re
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

from jaxswarm.config import plugins
from jaxswarm.config.groups import registries
from jaxswarm.config.keys import Config, experiment_fields, part_fields, validate
from jaxswarm.config.schema import ConfigError
from jaxswarm.config.settings import RunSettings

if TYPE_CHECKING:
    from jaxswarm.training import Experiment


def build(config: Config) -> "Experiment":
    """Build the experiment of a complete config; raises a `ConfigError` for impossible values."""
    import jax  # noqa: PLC0415

    from jaxswarm.networks import ActorCritic  # noqa: PLC0415
    from jaxswarm.training import Experiment, init  # noqa: PLC0415

    try:
        task, aggregator = build_part("task", config), build_part("aggregator", config)
        fields = _with_tuples(config["network"])
        with _prefixed("network", "aggregator", fields=config["aggregator"]):
            network = ActorCritic(**fields, aggregator=aggregator, action_dim=task.action_dim)
        sizes = {name: config[name] for name in experiment_fields()}
        experiment = Experiment(task, network, build_part("learner", config), **sizes)
        if network.latent_space == "shared":  # some aggregators reject a shared space for some groups of entities
            jax.eval_shape(init, experiment, jax.random.key(0))
        return experiment
    except ConfigError:
        raise
    except (TypeError, ValueError) as error:
        raise ConfigError(" ".join(str(error).split())) from error


def build_part(part: str, config: Config) -> Any:
    """Build the task, aggregator or learner of a config; raises a `ConfigError` for impossible values."""
    fields = _with_tuples(config[part])
    with _prefixed(part):
        return registries()[part][fields.pop("name")](**fields)


@contextlib.contextmanager
def _prefixed(part: str, other: str = "", fields: Iterable[str] = ()) -> Iterator[None]:
    """Turn errors of a constructor into a `ConfigError` that names the key with the part as its prefix.

    Keys in `fields` get the prefix `other` instead.
    """
    try:
        yield
    except (TypeError, ValueError) as error:
        is_field = re.match(r"(\w+): must ", str(error))
        part = other if is_field and is_field[1] in fields else part
        raise ConfigError(f"{part}{'.' if is_field else ': '}{' '.join(str(error).split())}") from error


def run_settings(config: Config) -> RunSettings:
    """Return the run settings of a complete config; raises a `ConfigError` for impossible values."""
    return RunSettings(**_with_tuples({field.name: config[field.name] for field in dataclasses.fields(RunSettings)}))


def describe(experiment: "Experiment", **settings: Any) -> Config | None:
    """Return the config from which `build` makes this experiment, with these `RunSettings`; `None` if there is none.

    There is no config if the network is no `ActorCritic`, if another part has no registered class, or if its class is
    defined in a notebook or the main script, which cannot be listed in `imports`.
    """
    from jaxswarm.networks import ActorCritic  # noqa: PLC0415

    network = experiment.network
    if type(network) is not ActorCritic:
        return None
    parts = {"task": experiment.task, "aggregator": network.aggregator, "learner": experiment.learner}
    try:
        names = {part: {"name": _registered_name(part, type(owner))} for part, owner in parts.items()}
        config: Config = {
            part: names.get(part, {}) | _plain(owner, part_fields(part, names.get(part, {})))
            for part, owner in (parts | {"network": network}).items()
        }
        imports = [one for owner in parts.values() if (one := plugins.import_of(type(owner)))]
        config = validate(config | _plain(experiment, experiment_fields()) | {"imports": imports} | settings)
        run_settings(config)
        return config if _are_equal(build(config), experiment) else None
    except ConfigError:
        return None


def _registered_name(part: str, cls: type) -> str:
    for name, registered in registries()[part].items():
        if registered is cls:
            return name
    raise ConfigError(f"{part}: must be a registered class ({', '.join(registries()[part])}), got {cls.__name__}")


def _plain(owner: Any, names: Iterable[str]) -> dict[str, Any]:
    """Return fields as YAML has them, with numbers of JAX and NumPy as Python numbers."""
    values = {name: getattr(owner, name) for name in names if name != "name"}
    return {name: x.item() if hasattr(x, "item") and x.ndim == 0 else x for name, x in values.items()}


def _with_tuples(fields: dict[str, Any]) -> dict[str, Any]:
    """Convert lists to tuples, which constructors expect."""
    return {name: tuple(x) if isinstance(x, list) else x for name, x in fields.items()}


def _are_equal(one: "Experiment", other: "Experiment") -> bool:
    import jax  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    if jax.tree.structure(one) != jax.tree.structure(other):
        return False
    return all(np.array_equal(x, y) for x, y in zip(*map(jax.tree.leaves, (one, other)), strict=True))
