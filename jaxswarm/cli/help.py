"""Help texts: groups with their choices, and keys with values and descriptions."""

import json
import textwrap
from collections.abc import Sequence
from typing import Any

from jaxswarm import config as configs

WIDTH = 120  # characters in a line
COLUMN = 36  # where descriptions start


def keys_help(overrides: Sequence[str]) -> str:
    """Return the groups with all choices, and all keys with the values that they have under these overrides.

    Raises a `ConfigError` for invalid overrides.
    """
    config, chosen = configs.compose(overrides), configs.selection(overrides)
    values, descriptions = configs.flat(config), configs.descriptions(config)
    sections = {"groups (* default)": _groups()}
    sections["keys"] = [_row(f"  {key}={_text(values[key])}", descriptions[key]) for key in values if "." not in key]
    for part in configs.PARTS:
        keys = [key for key in values if key.startswith(f"{part}.") and key != f"{part}.name"]
        rows = [_row(f"  {key}={_text(values[key])}", descriptions[key]) for key in keys]
        sections |= {f"keys of {part}={chosen[part]}": rows} if rows else {}
    return "\n\n".join("\n".join([title, *rows]) for title, rows in sections.items())


def figures_help(names: Sequence[str]) -> str:
    """Return the figures of these names with their descriptions."""
    return "\n".join(["figures", *[_row(f"  {name}", configs.description(configs.FIGURES, name)) for name in names]])


def _groups() -> list[str]:
    defaults = configs.selection()
    return [
        _row(f"  {'*' if choice == defaults[group] else ' '} {group}={choice}", configs.description(group, choice))
        for group, choices in configs.choices().items()
        for choice in choices
    ]


def _row(left: str, description: str) -> str:
    """Return a line with a description, which is wrapped, and starts below if the left text reaches into its column."""
    indent = " " * COLUMN
    text = description.replace("`", "")
    lines = textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False)
    if lines and len(left) < COLUMN:
        lines[0] = left.ljust(COLUMN) + lines[0][COLUMN:]
        return "\n".join(lines)
    return "\n".join([left, *lines])


def _text(value: Any) -> str:
    """Return a value as the command line takes it."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
