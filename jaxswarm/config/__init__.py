"""Configuration of runs: presets in YAML groups and `key=value` overrides, and the `Experiment` that they describe.

A preset names a registered class and gives values to its fields. Keys, types and descriptions are read off the classes,
so this package knows no single task, aggregator or learner. Classes that a user registers by `imports` can be chosen
without a preset. Invalid input raises a `ConfigError` with a message of one line before anything is compiled.
"""

from jaxswarm.config.composition import INIT_FROM, activate, compose, compose_pairs, dump, load, read, selection
from jaxswarm.config.conversion import build, build_part, describe, run_settings
from jaxswarm.config.groups import FIGURES, REGISTERED, SEARCHES, choices, config_dir, description, preset
from jaxswarm.config.keys import PARTS, Config, descriptions, flat, full_key, override, validate
from jaxswarm.config.overrides import combinations, parse
from jaxswarm.config.schema import ConfigError
from jaxswarm.config.settings import LENGTHS, RunSettings

__all__ = [
    "FIGURES",
    "INIT_FROM",
    "LENGTHS",
    "PARTS",
    "REGISTERED",
    "SEARCHES",
    "Config",
    "ConfigError",
    "RunSettings",
    "activate",
    "build",
    "build_part",
    "choices",
    "combinations",
    "compose",
    "compose_pairs",
    "config_dir",
    "describe",
    "description",
    "descriptions",
    "dump",
    "flat",
    "full_key",
    "load",
    "override",
    "parse",
    "preset",
    "read",
    "run_settings",
    "selection",
    "validate",
]
