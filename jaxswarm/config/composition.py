"""Configs from presets and overrides, and from and to files of run folders."""

import sys
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxswarm.config import plugins, renamed
from jaxswarm.config.groups import DESCRIPTION, choices, config_dir, read_yaml, unknown_choice, user_choices
from jaxswarm.config.keys import PARTS, Config, has_field, override, validate
from jaxswarm.config.overrides import parse
from jaxswarm.config.schema import ConfigError

INIT_FROM = "init_from"  # key of the run folder of a warm start

Choices = dict[str, Any]  # by group; the group `experiment` may have `None`
_translated_files: set[Path] = set()  # files whose translation has been reported


def compose(overrides: Sequence[str] = ()) -> Config:
    """Return the complete, validated config for overrides such as `learner=ppo` and `task.num_agents=50`.

    Raises a `ConfigError` for invalid overrides.
    """
    return compose_pairs(parse(overrides))


def compose_pairs(pairs: Sequence[tuple[str, Any]]) -> Config:
    """Return the config for overrides that are given as keys and values, as `compose` does."""
    pairs = [(key, _absolute(key, value)) for key, value in pairs]
    config, _ = _compose_groups(pairs)
    groups = choices()
    return override(config, [(key, value) for key, value in pairs if key not in groups])


def selection(overrides: Sequence[str] = ()) -> Choices:
    """Return the choice of each group under these overrides, including choices that an experiment preset makes."""
    return _compose_groups([(key, _absolute(key, value)) for key, value in parse(overrides)])[1]


def load(path: Path) -> Config:
    """Load the validated config of a run folder and run its imports, from the copies in the folder if files are gone.

    Keys of version 0.1 are translated, which one line on stderr reports. Raises a `ConfigError`.
    """
    config = read_yaml(path)
    imports = config.get("imports")
    if isinstance(imports, list) and all(isinstance(one, str) for one in imports):
        imports = plugins.locate(imports, path.parent)
    plugins.run(imports or [])
    return validate(_translate(config, path))


def read(path: Path) -> Config:
    """Return the content of a config file, also of another version, without validation and imports.

    Keys of version 0.1 are translated, which one line on stderr reports. Raises a `ConfigError` if the file cannot be
    read.
    """
    return _translate(read_yaml(path), path)


def dump(config: Config) -> str:
    """Return the config as YAML."""
    from omegaconf import OmegaConf  # noqa: PLC0415

    return OmegaConf.to_yaml(OmegaConf.create(config))


def _absolute(key: str, value: Any) -> Any:
    """Run the imports of an override, and make its paths absolute."""
    if key == "imports":
        return plugins.run(value)
    return str(Path(value).resolve()) if key == INIT_FROM and value and isinstance(value, str) else value


def _compose_groups(pairs: Sequence[tuple[str, Any]]) -> tuple[Config, Choices]:
    """Return the config of the presets that the pairs choose, not validated, and the choice of each group."""
    from hydra import compose, initialize_config_dir  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415

    groups = choices()
    chosen = {key: value for key, value in pairs if key in groups and (key, value) != ("experiment", None)}
    for group, choice in chosen.items():
        if choice not in groups[group]:
            raise unknown_choice(group, choice, groups[group])
    of_user = {group: choice for group, choice in chosen.items() if choice in user_choices(group)}
    presets = [f"{group}={choice}" for group, choice in chosen.items() if group not in of_user]
    try:
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            composed = compose("train", presets, return_hydra_config=True)
    except HydraException as error:
        raise ConfigError(" ".join(str(error).split())) from error
    selected = {group: composed.hydra.runtime.choices.get(group) for group in groups}
    own_keys = OmegaConf.masked_copy(composed, [str(key) for key in composed if key not in ("hydra", DESCRIPTION)])
    config = typing.cast(Config, OmegaConf.to_container(own_keys, resolve=True))
    for part in PARTS:
        config[part].pop(DESCRIPTION, None)
    return config | {group: {"name": choice} for group, choice in of_user.items()}, selected | of_user


def _translate(config: Config, path: Path) -> Config:
    """Return the config with the keys of version 0.1 translated, and report it once for each file."""
    config, changes = renamed.translate(config, lambda part, name: has_field(part, name, config))
    if changes and path.resolve() not in _translated_files:
        _translated_files.add(path.resolve())
        names = ", ".join(changes)
        print(f"{path} was written by jaxswarm 0.1; its keys were translated: {names}", file=sys.stderr)
    return config
