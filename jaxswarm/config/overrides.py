"""Parsing of overrides: `key=value` texts of the command line."""

import itertools
from collections.abc import Sequence
from typing import Any

from jaxswarm.config.schema import ConfigError

PATHS = ("init_from", "imports")  # keys whose values are paths


def parse(overrides: Sequence[str]) -> list[tuple[str, Any]]:
    """Return the keys and values of `key=value` overrides; raises a `ConfigError` if one has several values."""
    for text in overrides:
        if len(combinations([text])) > 1:
            raise ConfigError(f"override: must be key=value with one value, and lists as key=[1,2], got {text!r}")
    return combinations(overrides)[0]


def combinations(overrides: Sequence[str]) -> list[list[tuple[str, Any]]]:
    """Return the keys and values of overrides, one list for every combination of the values in `key=a,b`.

    Raises a `ConfigError` for a text that has another form.
    """
    choices = [[(key, value) for value in values] for key, values in map(_parse, overrides)]
    return [list(pairs) for pairs in itertools.product(*choices)]


def _parse(text: str) -> tuple[str, list[Any]]:
    """Return the key and the values of one override; paths are taken literally, whatever characters they contain."""
    key, _, value = text.partition("=")
    if key in PATHS and value and value != "null" and not value.startswith("["):
        return key, [value]
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415
    from hydra.core.override_parser.types import OverrideType  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415

    invalid = ConfigError(f"override: must be key=value, and lists as key=[1,2], got {text!r}")
    try:
        parsed = OverridesParser.create().parse_override(text)
    except HydraException as error:
        raise invalid from error
    is_range = parsed.is_sweep_override() and not parsed.is_choice_sweep()
    if parsed.type is not OverrideType.CHANGE or parsed.package or is_range:
        raise invalid
    values = parsed.sweep_iterator() if parsed.is_choice_sweep() else [parsed.value()]
    return parsed.key_or_group, list(values)
