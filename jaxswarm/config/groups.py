"""Config groups: folders of presets, and the registries of tasks, aggregators and learners."""

from pathlib import Path
from typing import Any

from jaxswarm.config import plugins, schema
from jaxswarm.config.schema import ConfigError

REGISTERED = ("task", "aggregator", "learner")  # groups whose presets have the `name` of a registered class
SEARCHES = "search"  # folder of search spaces, which are not part of a config
FIGURES = "figure"  # folder of figures, each of several configs
DESCRIPTION = "description"  # key of the description of a file, which is not part of a config


def config_dir() -> Path:
    """Return the folder of the groups: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    candidates = (package / "configs", package.parent / "configs")
    for candidate in candidates:
        if (candidate / "train.yaml").is_file():
            return candidate
    folders = " or ".join(map(str, candidates))
    raise ConfigError(f"train.yaml: must be in {folders}, got no such file; install jaxswarm again")


def registries() -> dict[str, dict[str, Any]]:
    """Return the registered classes by group and name."""
    from jaxswarm.aggregators import AGGREGATORS  # noqa: PLC0415
    from jaxswarm.learners import LEARNERS  # noqa: PLC0415
    from jaxswarm.tasks import TASKS  # noqa: PLC0415

    return {"task": TASKS, "aggregator": AGGREGATORS, "learner": LEARNERS}


def choices() -> dict[str, list[str]]:
    """Return the names that can be chosen in each group: its presets, and classes that user imports registered."""
    others = (SEARCHES, FIGURES)
    folders = sorted(path for path in config_dir().iterdir() if path.is_dir() and path.name not in others)
    presets = {folder.name: sorted(path.stem for path in folder.glob("*.yaml")) for folder in folders}
    return {group: [*names, *user_choices(group)] for group, names in presets.items()}


def user_choices(group: str) -> list[str]:
    """Return the names of the classes that user imports have registered in the group."""
    if group not in REGISTERED or not plugins.have_run:
        return []
    return sorted(name for name, cls in registries()[group].items() if not cls.__module__.startswith("jaxswarm."))


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the content of a YAML file; raises a `ConfigError` if it is no mapping or cannot be read."""
    from omegaconf import OmegaConf  # noqa: PLC0415

    try:
        content = OmegaConf.to_container(OmegaConf.load(path))
    except Exception as error:
        raise ConfigError(f"cannot read {path}: {error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"cannot read {path}: it contains no keys")
    return {str(key): value for key, value in content.items()}


def preset(group: str, choice: str) -> dict[str, Any]:
    """Return the values of a preset of a part, including those of the presets that it builds on."""
    values = read_yaml(config_dir() / group / f"{choice}.yaml")
    merged = {}
    for base in values.pop("defaults", []):
        merged |= preset(group, base)
    return {key: value for key, value in (merged | values).items() if key != DESCRIPTION}


def description(group: str, choice: str) -> str:
    """Return the description of a choice: that of its file, or the summary of a class that a user import registered."""
    if choice in user_choices(group):
        return schema.summary(registries()[group][choice])
    return read_yaml(config_dir() / group / f"{choice}.yaml")[DESCRIPTION]


def unknown_choice(group: str, value: Any, accepted: list[str]) -> ConfigError:
    """Return the error for a value that is no choice of the group."""
    near = schema.nearest(value, accepted) if isinstance(value, str) else ""
    return ConfigError(f"{group}: must be one of {', '.join(accepted)}, got {schema.shown(value)}{near}")
