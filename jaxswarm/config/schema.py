"""Constructor parameters: their types, defaults and descriptions, and checks of values against the types."""

import difflib
import inspect
import math
import types
import typing
from typing import Any, TypeGuard

from jaxswarm.limits import LARGER_INTEGERS, MAX_INTEGER, MAX_LENGTH, MAX_NUMBER

MAX_SHOWN = 200  # characters of a value in a message


class ConfigError(ValueError):
    """A value or key that the user gave is invalid; the message names it and says what is valid."""


def parameters(cls: Any) -> dict[str, inspect.Parameter]:
    """Return the constructor parameters of a class with resolved annotations, without those that flax adds."""
    hints = typing.get_type_hints(cls)
    is_module = hasattr(cls, "module_paths")
    return {
        name: parameter.replace(annotation=hints.get(name, parameter.annotation))
        for name, parameter in inspect.signature(cls).parameters.items()
        if not (is_module and name in ("parent", "name"))
    }


def descriptions(cls: type) -> dict[str, str]:
    """Return the description of each field: the `Attributes:` sections (Google style) of the class and its bases."""
    from docstring_parser import DocstringStyle, parse  # noqa: PLC0415

    found = {}
    for owner in reversed(cls.__mro__):
        fields = parse(owner.__doc__ or "", style=DocstringStyle.GOOGLE).params
        found |= {field.arg_name: " ".join((field.description or "").split()) for field in fields}
    return found


def summary(cls: type) -> str:
    """Return the first paragraph of the docstring of a class in one line; empty without a docstring."""
    text = " ".join((cls.__doc__ or "").partition("\n\n")[0].split())
    return "" if text.startswith(f"{cls.__name__}(") else text  # dataclasses write their signature there


def check(value: Any, annotation: Any, name: str) -> Any:
    """Return the value if it has the annotated type; an integer is converted where a float is expected.

    Lists are returned as lists, also for annotations of tuples. Integers in lists are sizes and must be >= 1. All
    numbers must be within `jaxswarm.limits`. Raises a `ConfigError` that calls the value `name` and lists the valid
    types.
    """
    _check_limits(value, annotation, name)
    for accepted in _members(annotation):
        if accepted is float and is_number(value) and not math.isnan(value):
            return float(value)
        if accepted in (bool, int, str, types.NoneType) and type(value) is accepted:
            return value
        if typing.get_origin(accepted) is typing.Literal and value in list(typing.get_args(accepted)):
            return value
        if typing.get_origin(accepted) is tuple and isinstance(value, list | tuple):
            element = typing.get_args(accepted)[0]
            elements = [check(x, element, f"{name}[{i}]") for i, x in enumerate(value)]
            if element is not int or min(elements, default=1) >= 1:
                return elements
    raise ConfigError(f"{name}: must be {_describe(annotation)}, got {shown(value)}{_spelling(value, annotation)}")


def is_number(value: Any) -> TypeGuard[int | float]:
    """Return whether a value is an integer or a float; booleans are neither."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def shown(value: Any) -> str:
    """Return a value as messages show it: its `repr` in one line, shortened if it is long."""
    try:
        text = repr(value)
    except ValueError:  # Python writes no integers of more than 4300 digits
        return f"a number of about {int(value.bit_length() * math.log10(2))} digits"
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


def _check_limits(value: Any, annotation: Any, name: str) -> None:
    members = _members(annotation)
    if is_number(value) and float in members and not math.isnan(value) and abs(value) > MAX_NUMBER:
        raise ConfigError(f"{name}: must be a finite number from {-MAX_NUMBER:g} to {MAX_NUMBER:g}, got {shown(value)}")
    most = LARGER_INTEGERS.get(name, MAX_INTEGER)
    if type(value) is int and float not in members and abs(value) > most:
        raise ConfigError(f"{name}: must be an integer of at most {most}, got {shown(value)}")
    if isinstance(value, list | tuple) and len(value) > MAX_LENGTH:
        raise ConfigError(f"{name}: must have at most {MAX_LENGTH} elements, got {len(value)}")


def _spelling(value: Any, annotation: Any) -> str:
    """Return the right spelling of a value that is close to valid, to append to a message."""
    if isinstance(value, float) and value.is_integer() and abs(value) <= MAX_INTEGER:
        return f" (write {int(value)})"
    is_tuple = [typing.get_origin(accepted) is tuple for accepted in _members(annotation)]
    if isinstance(value, list) and not any(is_tuple) and value and all(map(is_number, value)):
        return " (the values of a sweep have no brackets)"
    for accepted in _members(annotation):
        if typing.get_origin(accepted) is tuple and not isinstance(value, list | tuple | dict):
            element = typing.get_args(accepted)[0]
            is_literal = typing.get_origin(element) is typing.Literal
            if (is_literal and value in list(typing.get_args(element))) or (element is int and type(value) is int):
                return f" (write [{value}])"
    return ""


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
    """Return a suggestion of the most similar accepted word, to append to a message; empty if none is similar."""
    near = difflib.get_close_matches(word, accepted, n=1, cutoff=0.5 if "." not in word else 0.3)
    return f" (did you mean {near[0]!r}?)" if near else ""
