"""Keys and values that version 0.1 named differently."""

from collections.abc import Callable
from typing import Any

KEYS = {  # by the name in version 0.1
    "num_worlds": "num_envs",
    "eval_worlds": "num_eval_envs",
    "desynchronised_start": "desynchronized_start",
    "learner.max_gradient_norm": "learner.max_grad_norm",
    "learner.coefficient": "learner.regression_coefficient",
    "learner.minibatch": "learner.sampling_unit",
}
VALUES = {("learner.sampling_unit", "worlds"): "envs", ("task.relative_velocity", "normalised"): "normalized"}


def current_key(key: str) -> str | None:
    """Return the present name of a key of version 0.1, with a prefix if `key` has one; `None` for other keys."""
    without_prefix = {old.rpartition(".")[2]: new.rpartition(".")[2] for old, new in KEYS.items()}
    return KEYS.get(key) or without_prefix.get(key)


def current_value(key: str, value: Any) -> str | None:
    """Return the present name of a value of version 0.1 under the present key; `None` for other values."""
    return VALUES.get((key, value)) if isinstance(value, str) else None


def translate_override(text: str) -> str:
    """Return an override of version 0.1, such as `num_worlds=2,4`, with the present names."""
    key, equals, value = text.partition("=")
    key = current_key(key) or key
    full = {new.rpartition(".")[2]: new for new, _ in VALUES}.get(key, key)
    values = [current_value(full, x) or x for x in value.split(",")]
    return f"{key}{equals}{','.join(values)}"


def translate(config: dict[str, Any], has_field: Callable[[str, str], bool]) -> tuple[dict[str, Any], list[str]]:
    """Return the config with present names, and one text "old -> new" for each name of version 0.1 in it.

    `has_field(part, name)` says whether a key of version 0.1 is a field of the part, such as a user's learner, so that
    it must not be translated.
    """
    changes: list[str] = []

    def translated(fields: dict[str, Any], part: str) -> dict[str, Any]:
        prefix = f"{part}." if part else ""
        result = {}
        for name, value in fields.items():
            key = old = f"{prefix}{name}"
            if old in KEYS and not (part and has_field(part, name)):
                key = KEYS[old]
            new_value = current_value(key, value)
            if new_value is not None:
                changes.append(f"{old}={value} -> {key}={new_value}")
            elif key != old:
                changes.append(f"{old} -> {key}")
            result[key.removeprefix(prefix)] = value if new_value is None else new_value
        return result

    parts = {name: translated(x, name) if isinstance(x, dict) else x for name, x in config.items()}
    return translated(parts, ""), changes
