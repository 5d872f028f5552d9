"""What constructors take, read off their signatures, and whether a value that a user wrote is of such a type."""

import difflib
import inspect
import math
import types
import typing
from typing import Any


class ConfigError(ValueError):
    """Something the user wrote is not possible; the message says what would be."""


def parameters(cls: Any) -> dict[str, inspect.Parameter]:
    """Constructor parameters with resolved annotations; what flax adds to modules is left out."""
    hints = typing.get_type_hints(cls)
    is_module = hasattr(cls, "module_paths")
    return {
        name: parameter.replace(annotation=hints.get(name, parameter.annotation))
        for name, parameter in inspect.signature(cls).parameters.items()
        if not (is_module and name in ("parent", "name"))
    }


def check(value: Any, annotation: Any, name: str) -> Any:
    """The value as that type; integers pass for floats, nothing else passes for anything else.

    A `ConfigError` calls the value by this name and says which types would pass.
    """
    for accepted in _members(annotation):
        if accepted is float and isinstance(value, int | float) and type(value) is not bool and math.isfinite(value):
            return float(value)
        if accepted in (bool, int, str, types.NoneType) and type(value) is accepted:
            return value
        if typing.get_origin(accepted) is typing.Literal and value in typing.get_args(accepted):
            return value
        if typing.get_origin(accepted) is tuple and isinstance(value, list | tuple):
            element = typing.get_args(accepted)[0]
            elements = [check(x, element, f"{name}[{i}]") for i, x in enumerate(value)]
            if element is not int or min(elements, default=1) >= 1:  # integers in lists are sizes
                return elements
    hint = f" (write {int(value)})" if isinstance(value, float) and value.is_integer() else ""
    raise ConfigError(f"{name}: must be {_describe(annotation)}, got {value!r}{hint}")


def _members(annotation: Any) -> tuple:
    is_union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    return typing.get_args(annotation) if is_union else (annotation,)


def _describe(annotation: Any) -> str:
    names = {bool: "true or false", int: "an integer, like 8", float: "a number, like 1e-3", str: "text"}
    described = []
    for accepted in _members(annotation):
        if typing.get_origin(accepted) is typing.Literal:
            described.append(f"one of {', '.join(map(str, typing.get_args(accepted)))}")
        elif typing.get_origin(accepted) is tuple:
            element = typing.get_args(accepted)[0]
            named = f"a list of {_describe(element)}"
            described.append("a list of integers >= 1, like [120,60]" if element is int else named)
        elif accepted is types.NoneType:
            described.append("null")
        elif accepted in names:
            described.append(names[accepted])
    return " or ".join(described)


def nearest(word: str, accepted: list[str]) -> str:
    """Suggestion of the most similar word, to be appended to a message; empty if no word is similar."""
    near = difflib.get_close_matches(word, accepted, n=1, cutoff=0.5 if "." not in word else 0.3)
    return f" (did you mean {near[0]!r}?)" if near else ""
