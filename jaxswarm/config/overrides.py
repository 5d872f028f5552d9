"""Parsing of overrides: `key=value` texts of the command line."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

from jaxswarm.config.schema import ConfigError, shown

PATHS = ("init_from", "imports")  # keys whose values are paths
MAX_COMBINATIONS = 1000  # of the values of a sweep


def parse(overrides: Sequence[str]) -> list[tuple[str, Any]]:
    """Return the keys and values of `key=value` overrides; raises a `ConfigError` if one has several values."""
    for text in overrides:
        if len(combinations([text])) > 1:
            raise ConfigError(f"override: must be key=value with one value, and lists as key=[1,2], got {shown(text)}")
    return combinations(overrides)[0]


def combinations(overrides: Sequence[str]) -> list[list[tuple[str, Any]]]:
    """Return the keys and values of overrides, one list for every combination of the values in `key=a,b`.

    Raises a `ConfigError` for a text that has another form, and for more than `MAX_COMBINATIONS` combinations.
    """
    choices = [[(key, value) for value in values] for key, values in map(_parse, overrides)]
    number = math.prod(map(len, choices))
    if number > MAX_COMBINATIONS:
        raise ConfigError(f"sweep: must have at most {MAX_COMBINATIONS} combinations of values, got {number}")
    return [list(pairs) for pairs in itertools.product(*choices)]


def _parse(text: str) -> tuple[str, list[Any]]:
    """Return the key and the values of one override; paths are taken literally, whatever characters they contain."""
    key, _, value = text.partition("=")
    if key in PATHS and value and value != "null" and not value.startswith("["):
        return key, [value]
    from hydra.core.override_parser.overrides_parser import OverridesParser  # noqa: PLC0415
    from hydra.core.override_parser.types import OverrideType, ValueType  # noqa: PLC0415
    from hydra.errors import HydraException  # noqa: PLC0415

    invalid = ConfigError(f"override: must be key=value, and lists as key=[1,2], got {shown(text)}")
    try:
        parsed = OverridesParser.create().parse_override(text)
    except (HydraException, ValueError, RecursionError) as error:
        raise invalid from error
    is_choice = parsed.value_type in (ValueType.CHOICE_SWEEP, ValueType.SIMPLE_CHOICE_SWEEP)
    if (
        parsed.type is not OverrideType.CHANGE
        or parsed.package
        or not (is_choice or parsed.value_type is ValueType.ELEMENT)
    ):
        raise invalid
    values = parsed.sweep_iterator() if is_choice else [parsed.value()]
    try:
        return parsed.key_or_group, [_plain(value) for value in values]
    except (TypeError, ValueError) as error:
        raise invalid from error


def _plain(value: Any) -> Any:
    """Return a value of numbers, texts, booleans, null, lists and mappings; raises a `TypeError` for other values."""
    if isinstance(value, list):
        return [_plain(x) for x in value]
    if isinstance(value, dict):
        return {str(_plain(key)): _plain(x) for key, x in value.items()}
    value = getattr(value, "text", value)  # of a quoted text
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(type(value).__name__)
