"""What a user writes about a run: YAML groups and `key=value` words in, an `Experiment` out.

A group's file names a registered class and the fields it is built with. Which keys exist and what values they take is
read off the constructors, so nothing here knows any single task, aggregator or learner. What a user has registered by
a file of `imports` is a choice without a file here. All that is wrong is a `ConfigError` of one line, raised before
anything is compiled.
"""

import dataclasses
import inspect
import itertools
import math
import re
import typing
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jaxswarm.config import plugins as imports
from jaxswarm.config import schema
from jaxswarm.config.schema import ConfigError

if TYPE_CHECKING:
    from jaxswarm.training import Experiment

Config = dict[str, Any]

REGISTERED = ("task", "aggregator", "learner")  # groups whose files have a `name`
NO_PRESET = ("experiment", None)
PARTS = (*REGISTERED, "network")  # what an experiment is made of, one dict each
SEARCHES = "search"  # the folder of search spaces, which are no part of a config
FIGURES = "figure"  # that of figures, each of several configs
INIT_FROM = "init_from"  # the key of the folder with the policy to begin with
LENGTHS = ("num_updates", "total_agent_steps")  # two ways to say the same


@dataclasses.dataclass(frozen=True)
class RunSettings:
    """What a config says beyond the experiment; of `num_updates` and `total_agent_steps`, one is given."""

    seed: int = 0
    num_seeds: int = 1
    num_updates: int | None = None
    total_agent_steps: int | None = None
    checkpoint_seconds: float = 30.0
    keep_checkpoints: int = 3
    render_every: int | None = None
    loggers: tuple[Literal["tensorboard", "wandb"], ...] = ()
    init_from: str | None = None
    imports: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if (self.num_updates is None) == (self.total_agent_steps is None):
            raise ConfigError("give one of num_updates and total_agent_steps")
        for field in dataclasses.fields(self):
            name, value = field.name, getattr(self, field.name)
            bound = 0 if name in ("seed", "checkpoint_seconds") else 1
            if isinstance(value, int | float) and value < bound:
                raise ConfigError(f"{name}: must be a number >= {bound}, got {value!r}")
        if self.seed + self.num_seeds > 2**32:
            raise ConfigError(f"seed: seed + num_seeds must be at most 2**32, got {self.seed} + {self.num_seeds}")

    @property
    def seeds(self) -> tuple[int, ...]:
        """Those that are trained side by side."""
        return tuple(range(self.seed, self.seed + self.num_seeds))

    def length(self, agent_steps_per_update: int) -> int:
        """Number of updates; a last update that is only partly wanted is done in full."""
        if self.num_updates is not None:
            return self.num_updates
        assert self.total_agent_steps is not None
        return math.ceil(self.total_agent_steps / agent_steps_per_update)


def config_dir() -> Path:
    """Where the groups are: inside the package once installed, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    places = (package / "configs", package.parent / "configs")
    for place in places:
        if (place / "train.yaml").is_file():
            return place
    raise ConfigError(f"the default configs are not installed; looked in {' and '.join(map(str, places))}")


def choices() -> dict[str, list[str]]:
    """Names of the groups, and of the files in each."""
    others = (SEARCHES, FIGURES)
    groups = sorted(path for path in config_dir().iterdir() if path.is_dir() and path.name not in others)
    return {group.name: sorted(path.stem for path in group.glob("*.yaml")) + _own(group.name) for group in groups}


def _own(group: str) -> list[str]:
    """Names that files of `imports` have registered."""
    if group not in REGISTERED or not imports.have_run:
        return []
    return sorted(name for name, cls in _registries()[group].items() if not cls.__module__.startswith("jaxswarm."))


def compose(overrides: Sequence[str] = ()) -> Config:
    """The config that `words` such as `learner=ppo` and `task.num_agents=50` ask for: checked, complete, plain data."""
    return compose_pairs(parse(overrides))


def compose_pairs(pairs: Sequence[tuple[str, Any]]) -> Config:
    """`compose` for keys and values."""
    from hydra import compose, initialize_config_dir  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415

    pairs = [(key, imports.run(value)) if key == "imports" else (key, value) for key, value in pairs]
    pairs = [(key, str(Path(value).resolve()) if key == INIT_FROM and value else value) for key, value in pairs]
    groups = choices()
    chosen = {
        key: _choice(key, value, groups[key]) for key, value in pairs if key in groups and (key, value) != NO_PRESET
    }
    own = {group: {"name": choice} for group, choice in chosen.items() if choice in _own(group)}
    try:
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            composed = compose("train", [f"{group}={x}" for group, x in chosen.items() if group not in own])
    except HydraException as error:
        raise ConfigError(" ".join(str(error).split())) from error
    config = typing.cast(Config, OmegaConf.to_container(composed, resolve=True)) | own
    return override(config, [(key, value) for key, value in pairs if key not in groups])


def load(path: Path) -> Config:
    """The config of a run, as `dump` wrote it; imports what it was trained with, or the run folder's copies of it."""
    config = read(path)
    places = config.get("imports")
    imports.run(imports.found(places, path.parent) if isinstance(places, list) else places or [])
    return validate(config)


def read(path: Path) -> Config:
    """What a file says, be it the config of a run of another version."""
    from omegaconf import OmegaConf  # noqa: PLC0415

    try:
        config = OmegaConf.to_container(OmegaConf.load(path))
    except Exception as error:
        raise ConfigError(f"cannot read {path}: {error}") from error
    if not isinstance(config, dict):
        raise ConfigError(f"cannot read {path}: no keys in it")
    return typing.cast(Config, config)


def preset(group: str, choice: str) -> dict[str, Any]:
    """The values of a choice, those of its defaults included."""
    values = read(config_dir() / group / f"{choice}.yaml")
    merged = {}
    for default in values.pop("defaults", []):
        merged |= preset(group, default)
    return merged | values


def dump(config: Config) -> str:
    """The config as YAML."""
    from omegaconf import OmegaConf  # noqa: PLC0415

    return OmegaConf.to_yaml(OmegaConf.create(config))


def flat(config: Mapping[str, Any]) -> dict[str, Any]:
    """Values by dotted key."""
    parts = {key: value if isinstance(value, dict) else {"": value} for key, value in config.items()}
    return {f"{key}.{name}" if name else key: x for key, fields in parts.items() for name, x in fields.items()}


def parse(overrides: Sequence[str]) -> list[tuple[str, Any]]:
    """Keys and values of `key=value` words."""
    several = [word for word in overrides if len(combinations([word])) > 1]
    if several:
        raise ConfigError(f"cannot read {several[0]!r}: write key=value with one value, and lists as key=[1,2]")
    return combinations(overrides)[0]


def combinations(overrides: Sequence[str]) -> list[list[tuple[str, Any]]]:
    """Keys and values of `key=value` words; of words like `key=a,b` every combination of values."""
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415
    from hydra.core.override_parser.types import OverrideType  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415

    parser, choices = OverridesParser.create(), []
    for word in overrides:
        try:
            parsed = parser.parse_override(word)
        except HydraException as error:
            raise ConfigError(f"cannot read {word!r}: write key=value, and lists as key=[1,2]") from error
        is_range = parsed.is_sweep_override() and not parsed.is_choice_sweep()
        if parsed.type is not OverrideType.CHANGE or parsed.package or is_range:
            raise ConfigError(f"cannot read {word!r}: write key=value, and lists as key=[1,2]")
        values = parsed.sweep_iterator() if parsed.is_choice_sweep() else [parsed.value()]
        choices.append([(parsed.key_or_group, value) for value in values])
    return [list(pairs) for pairs in itertools.product(*choices)]


def override(config: Config, pairs: Iterable[tuple[str, Any]]) -> Config:
    """The config with other values at these keys, checked. A given length replaces the other way to say it."""
    config = {key: dict(value) if isinstance(value, dict) else value for key, value in config.items()}
    pairs = list(pairs)
    lengths = {key for key, _ in pairs} & set(LENGTHS)
    if len(lengths) == 1:
        config |= dict.fromkeys(set(LENGTHS) - lengths)
    for key, value in pairs:
        head, _, tail = full_key(key, config).partition(".")
        if not tail:
            if isinstance(config.get(key), dict):
                raise ConfigError(f"{key}: set single fields with {key}.<field>=value, got {value!r}")
            config[key] = value
        elif isinstance(config.get(head), dict):
            config[head][tail] = value
        else:
            raise _unknown(key, "", config)
    return validate(config)


def full_key(key: str, config: Config) -> str:
    """The key in full: a field's name stands for `part.name` where only one part has it."""
    if "." in key or key in config or key in _top_fields():
        return key
    owners = [part for part in PARTS if key in _fields(part, config[part])]
    if len(owners) > 1:
        choice = " or ".join(f"{part}.{key}" for part in owners)
        raise ConfigError(f"{key} is a field of {' and '.join(owners)}: write {choice}")
    return f"{owners[0]}.{key}" if owners else key


def validate(config: Config) -> Config:
    """The same config, complete with defaults and with values of the right types; an error for what does not exist."""
    missing = [part for part in PARTS if not isinstance(config.get(part), dict)]
    if missing:
        raise ConfigError(f"the config has no {missing[0]}; it needs {', '.join(PARTS)}")
    checked = {part: _check_fields(config[part], _fields(part, config[part]), part, config) for part in PARTS}
    rest = {key: value for key, value in config.items() if key not in PARTS}
    return checked | _check_fields(rest, _top_fields(), "", config)


def build(config: Config) -> "Experiment":
    """The experiment that a config describes; a `ConfigError` says which size is impossible."""
    import jax  # noqa: PLC0415

    from jaxswarm.networks import ActorCritic  # noqa: PLC0415
    from jaxswarm.training import Experiment, init  # noqa: PLC0415

    try:
        task = build_part("task", config)
        fields = _tuples(config["network"])
        network = ActorCritic(**fields, aggregator=build_part("aggregator", config), action_dim=task.action_dim)
        sizes = {name: config[name] for name in _experiment_fields()}
        experiment = Experiment(task, network, build_part("learner", config), **sizes)
        if network.latent_space == "shared":  # which not every aggregator can, with some groups
            jax.eval_shape(init, experiment, jax.random.key(0))
        return experiment
    except ConfigError:
        raise
    except (TypeError, ValueError) as error:
        raise ConfigError(str(error)) from error


def describe(experiment: "Experiment", **settings: Any) -> Config | None:
    """The config that `build` makes this experiment of, with these fields of `Run`; `None` if there is none.

    There is none for a network of one's own, nor if another part is of no registered class, or of one from a notebook
    or a script, which are no `imports`.
    """
    import jax  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    from jaxswarm.networks import ActorCritic  # noqa: PLC0415

    network = experiment.network
    if type(network) is not ActorCritic:
        return None
    parts = {"task": experiment.task, "aggregator": network.aggregator, "learner": experiment.learner}
    try:
        names = {part: {"name": _registered_name(part, type(owner))} for part, owner in parts.items()}
        config: Config = {
            part: names.get(part, {}) | _plain(owner, _fields(part, names.get(part, {})))
            for part, owner in (parts | {"network": network}).items()
        }
        places = [place for owner in parts.values() if (place := imports.place(type(owner)))]
        config = validate(config | _plain(experiment, _experiment_fields()) | {"imports": places} | settings)
        run_settings(config)
        built = build(config)
    except ConfigError:
        return None
    if jax.tree.structure(built) != jax.tree.structure(experiment):
        return None
    same = [np.array_equal(x, y) for x, y in zip(*map(jax.tree.leaves, (built, experiment)), strict=True)]
    return config if all(same) else None


def _registered_name(part: str, cls: type) -> str:
    for name, registered in _registries()[part].items():
        if registered is cls:
            return name
    raise ConfigError(f"{part}: must be a registered class ({', '.join(_registries()[part])}), got {cls.__name__}")


def _plain(owner: Any, names: Iterable[str]) -> dict[str, Any]:
    """Fields as YAML has them: numbers of JAX and NumPy as those of Python."""
    values = {name: getattr(owner, name) for name in names if name != "name"}
    return {name: x.item() if hasattr(x, "item") and x.ndim == 0 else x for name, x in values.items()}


def build_part(part: str, config: Config) -> Any:
    """The registered class of one part, built with its fields."""
    fields = _tuples(config[part])
    try:
        return _registries()[part][fields.pop("name")](**fields)
    except (TypeError, ValueError) as error:
        is_field = re.match(r"\w+: must ", str(error))
        raise ConfigError(f"{part}{'.' if is_field else ': '}{error}") from error


def _tuples(fields: dict[str, Any]) -> dict[str, Any]:
    """Lists as the tuples that constructors take."""
    return {name: tuple(x) if isinstance(x, list) else x for name, x in fields.items()}


def run_settings(config: Config) -> RunSettings:
    """What the config says beyond the experiment."""
    return RunSettings(**_tuples({field.name: config[field.name] for field in dataclasses.fields(RunSettings)}))


def _registries() -> dict[str, dict[str, Any]]:
    from jaxswarm.aggregators import AGGREGATORS  # noqa: PLC0415
    from jaxswarm.learners import LEARNERS  # noqa: PLC0415
    from jaxswarm.tasks import TASKS  # noqa: PLC0415

    return {"task": TASKS, "aggregator": AGGREGATORS, "learner": LEARNERS}


def _fields(part: str, values: dict) -> dict[str, inspect.Parameter]:
    """Fields that the part with these values has, its name included."""
    if part == "network":
        from jaxswarm.networks import ActorCritic  # noqa: PLC0415

        fields = schema.parameters(ActorCritic)
        del fields["aggregator"], fields["action_dim"]  # come from other parts
        return fields
    registry = _registries()[part]
    if values.get("name") not in registry:
        raise _unknown_choice(f"{part}.name", values.get("name"), list(registry))
    name = inspect.Parameter("name", inspect.Parameter.KEYWORD_ONLY, annotation=str)
    return {"name": name} | schema.parameters(registry[values["name"]])


def _experiment_fields() -> dict[str, inspect.Parameter]:
    from jaxswarm.training import Experiment  # noqa: PLC0415

    return {name: field for name, field in schema.parameters(Experiment).items() if name not in PARTS}


def _top_fields() -> dict[str, inspect.Parameter]:
    return schema.parameters(RunSettings) | _experiment_fields()


def _check_fields(values: dict, fields: dict[str, inspect.Parameter], part: str, config: Config) -> dict:
    full_name = {name: f"{part}.{name}" if part else str(name) for name in [*values, *fields]}
    for name in values:
        if name not in fields:
            raise _unknown(full_name[name], part, config)
    given = {name: schema.check(value, fields[name].annotation, full_name[name]) for name, value in values.items()}
    defaults = {name: field.default for name, field in fields.items() if name not in given}
    missing = [name for name, default in defaults.items() if default is inspect.Parameter.empty]
    if missing:
        raise ConfigError(f"{full_name[missing[0]]} is missing")
    return given | {name: list(x) if isinstance(x, tuple) else x for name, x in defaults.items()}


def _unknown(key: str, prefix: str, config: Config) -> ConfigError:
    """The error for a key that does not exist; lists those that do beside it."""
    fields = {part: [f"{part}.{name}" for name in _fields(part, config[part])] for part in PARTS}
    top = [*choices(), *_top_fields()]
    every = [*itertools.chain(*fields.values()), *top]
    same_leaf = [name for name in every if name.rpartition(".")[2] == key.rpartition(".")[2]]
    accepted = fields[prefix] if prefix else [*top, *(f"{part}.<field>" for part in PARTS)]
    return ConfigError(
        f"unknown key {key!r}{schema.nearest(key, same_leaf or every)}; valid keys: {', '.join(accepted)}"
    )


def _choice(group: str, value: Any, accepted: list[str]) -> str:
    if value not in accepted:
        raise _unknown_choice(group, value, accepted)
    return value


def _unknown_choice(group: str, value: Any, accepted: list[str]) -> ConfigError:
    near = schema.nearest(str(value), accepted)
    return ConfigError(f"{group}: must be one of {', '.join(accepted)}, got {value!r}{near}")
