"""Keys of a config: names, types, defaults and descriptions, which are read off the classes that have the fields."""

import inspect
import itertools
from collections.abc import Iterable, Mapping
from typing import Any

from jaxswarm.config import renamed, schema
from jaxswarm.config.groups import REGISTERED, choices, preset, registries, unknown_choice, user_choices
from jaxswarm.config.schema import ConfigError
from jaxswarm.config.settings import LENGTHS, RunSettings

Config = dict[str, Any]
Fields = dict[str, inspect.Parameter]

PARTS = (*REGISTERED, "network")  # parts of an experiment, each a dict in its config


def part_fields(part: str, values: Mapping[str, Any]) -> Fields:
    """Return the fields of a part whose class the values select, including `name`; raises a `ConfigError`."""
    fields = schema.parameters(_part_class(part, values))
    if part == "network":
        del fields["aggregator"], fields["action_dim"]  # follow from other parts
        return fields
    return {"name": inspect.Parameter("name", inspect.Parameter.KEYWORD_ONLY, annotation=str)} | fields


def experiment_fields() -> Fields:
    """Return the fields of an experiment except its parts."""
    from jaxswarm.training import Experiment  # noqa: PLC0415

    return {name: field for name, field in schema.parameters(Experiment).items() if name not in PARTS}


def top_fields() -> Fields:
    """Return the fields that are not of a part: those of the run and of the experiment."""
    return schema.parameters(RunSettings) | experiment_fields()


def descriptions(config: Config) -> dict[str, str]:
    """Return a description of each key of a complete config, by dotted key; empty for fields without documentation."""
    from jaxswarm.training import Experiment  # noqa: PLC0415

    top = schema.descriptions(Experiment) | schema.descriptions(RunSettings)
    top |= {f"{part}.name": f"The class of the {part} is registered under this name." for part in REGISTERED}
    for part in PARTS:
        top |= {f"{part}.{name}": x for name, x in schema.descriptions(_part_class(part, config[part])).items()}
    return {key: top.get(key, "") for key in flat(config)}


def flat(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values by dotted key."""
    parts = {key: value if isinstance(value, dict) else {"": value} for key, value in config.items()}
    return {f"{key}.{name}" if name else key: x for key, fields in parts.items() for name, x in fields.items()}


def full_key(key: str, config: Config) -> str:
    """Return the key with its prefix, which may be omitted if only one part has the field.

    Raises a `ConfigError` if several parts have it. An unknown key is returned unchanged.
    """
    if "." in key or key in config or key in top_fields():
        return key
    owners = [part for part in PARTS if key in part_fields(part, config[part])]
    if len(owners) > 1:
        raise ConfigError(f"{key}: must be one of {', '.join(f'{part}.{key}' for part in owners)}, got {key!r}")
    return f"{owners[0]}.{key}" if owners else key


def override(config: Config, pairs: Iterable[tuple[str, Any]]) -> Config:
    """Return the validated config with other values at these keys; raises a `ConfigError`.

    If `pairs` give one of `num_updates` and `total_agent_steps`, the other becomes null.
    """
    config = {key: dict(value) if isinstance(value, dict) else value for key, value in config.items()}
    pairs = list(pairs)
    lengths = {key for key, _ in pairs} & set(LENGTHS)
    if len(lengths) == 1:
        config |= dict.fromkeys(set(LENGTHS) - lengths)
    for key, value in pairs:
        head, _, tail = full_key(key, config).partition(".")
        if not tail:
            if isinstance(config.get(key), dict):
                raise ConfigError(f"{key}: must be set field by field with {key}.<field>=value, got {value!r}")
            config[key] = value
        elif isinstance(config.get(head), dict):
            config[head][tail] = value
        else:
            raise _unknown_key(key, "", config)
    return validate(config)


def validate(config: Config) -> Config:
    """Return the config with defaults for missing keys and with values of the annotated types.

    Raises a `ConfigError` for an unknown key, a missing key without default and a value of another type.
    """
    missing = [part for part in PARTS if not isinstance(config.get(part), dict)]
    if missing:
        raise ConfigError(f"{missing[0]}: must be a mapping of fields, got {config.get(missing[0])!r}")
    checked = {part: _check_fields(config[part], part_fields(part, config[part]), part, config) for part in PARTS}
    rest = {key: value for key, value in config.items() if key not in PARTS}
    return checked | _check_fields(rest, top_fields(), "", config)


def has_field(part: str, name: str, config: Config) -> bool:
    """Return whether the part of the config has a field of this name; false if its class is not registered."""
    try:
        return name in part_fields(part, config[part])
    except ConfigError:
        return False


def _part_class(part: str, values: Mapping[str, Any]) -> type:
    if part == "network":
        from jaxswarm.networks import ActorCritic  # noqa: PLC0415

        return ActorCritic
    registry = registries()[part]
    name = values.get("name")
    if not isinstance(name, str) or name not in registry:
        raise unknown_choice(f"{part}.name", name, list(registry))
    return registry[name]


def _check_fields(values: dict, fields: Fields, part: str, config: Config) -> dict:
    keys = {name: f"{part}.{name}" if part else str(name) for name in [*values, *fields]}
    for name in values:
        if name not in fields:
            raise _unknown_key(keys[name], part, config)
    given = {name: _check_value(value, fields[name], keys[name]) for name, value in values.items()}
    defaults = {name: field.default for name, field in fields.items() if name not in given}
    missing = [name for name, default in defaults.items() if default is inspect.Parameter.empty]
    if missing:
        raise ConfigError(f"{keys[missing[0]]}: must be given, because it has no default")
    return given | {name: list(x) if isinstance(x, tuple) else x for name, x in defaults.items()}


def _check_value(value: Any, field: inspect.Parameter, key: str) -> Any:
    current = renamed.current_value(key, value)
    if current is not None:
        raise ConfigError(f"{key}: {value} was renamed to {current}")
    return schema.check(value, field.annotation, key)


def _unknown_key(key: str, prefix: str, config: Config) -> ConfigError:
    """Return the error for an unknown key: its present name, its group's choices, or the nearest and all valid keys."""
    current = renamed.current_key(key)
    if current is not None:
        return ConfigError(f"{key}: renamed to {current}")
    fields = {part: [f"{part}.{name}" for name in part_fields(part, config[part])] for part in PARTS}
    top = [*choices(), *top_fields()]
    every = [*itertools.chain(*fields.values()), *top]
    leaf = key.rpartition(".")[2]
    same_leaf = [name for name in every if name.rpartition(".")[2] == leaf]
    accepted = fields[prefix] if prefix else [*top, *(f"{part}.<field>" for part in PARTS)]
    ours = renamed.key_of_other_library(key)
    if ours in every:
        near = f" (did you mean {ours!r}?)"
    elif not same_leaf and (owners := _owners(leaf, prefix)):
        part, names = next(iter(owners.items()))
        options = " or ".join(f"{part}={name}" for name in names)
        return ConfigError(f"{part}.{leaf}: must be used with {options}, got {part}.name={config[part]['name']}")
    else:
        near = _nearest_key(key, same_leaf or every)
    return ConfigError(f"unknown key {schema.shown(key)}{near}; valid keys: {', '.join(accepted)}")


def _owners(name: str, prefix: str) -> dict[str, list[str]]:
    """Return the choices whose class has a field of this name, by part; with a `prefix`, only of this part."""
    owners = {}
    for part in [prefix] if prefix in REGISTERED else REGISTERED:
        has_name = {own for own, cls in registries()[part].items() if name in schema.parameters(cls)}
        users = set(user_choices(part))
        found = [x for x in choices()[part] if (x if x in users else preset(part, x)["name"]) in has_name]
        owners |= {part: found} if found else {}
    return owners


def _nearest_key(key: str, keys: list[str]) -> str:
    """Return a suggestion for a misspelled key: within the same part if it names one, and also for names of 0.1."""
    part = key.partition(".")[0]
    keys = [name for name in keys if name.startswith(f"{part}.")] if "." in key and part in PARTS else keys
    old = {name: new for name, new in renamed.KEYS.items() if new in keys}
    suggestion = schema.nearest(key, [*keys, *old])
    for name, new in old.items():
        suggestion = suggestion.replace(f"{name!r}", f"{new!r}")
    return suggestion
