"""Checks of user-defined fields: each check has a description for error messages and a predicate."""

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxswarm.limits import MAX_ENTITIES, MAX_INTEGER


class Check(NamedTuple):
    """A condition on a value; `description` completes the sentence "must be ...".

    Values above `most` get a message of their own, because the description does not mention it.
    """

    description: str
    accepts: Callable[[Any], bool]
    most: float = math.inf


def require(owner: Any, check: Check, *names: str) -> None:
    """Raise a `ValueError` for the first field in `names` of `owner` that fails the check.

    Arrays (JAX or NumPy) and tracers are not checked, because their values may be unknown.
    """
    for name in names:
        value = getattr(owner, name)
        is_array = isinstance(value, jax.Array) or (isinstance(value, np.ndarray) and value.ndim > 0)
        if not is_array and not _holds(check, value):
            is_large = isinstance(value, int) and value > check.most
            accepted = f"an integer of at most {check.most}" if is_large else check.description
            raise ValueError(f"{name}: must be {accepted}, got {value!r}")


def _holds(check: Check, value: Any) -> bool:
    try:
        return bool(check.accepts(value))
    except TypeError:  # the predicate compares numbers and the value is not a number
        return False


def integer(least: int, most: int | None = None) -> Check:
    """Accept integers from `least` to `most` (`None`: `MAX_INTEGER`), both included; booleans are rejected."""
    if most is None:
        return size(least, MAX_INTEGER)
    return Check(f"an integer from {least} to {most}", size(least, most).accepts)


def size(least: int, most: int = MAX_ENTITIES) -> Check:
    """Accept integers from `least` to a number `most` beyond any reasonable size."""

    def accepts(value: Any) -> bool:
        is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
        return is_integer and bool(least <= value <= most)

    return Check(f"an integer >= {least}", accepts, most)


def choice(names: Iterable[Any]) -> Check:
    """Accept any of the given names; `None` among them is described as null."""
    names = tuple(names)
    return Check(f"one of {', '.join('null' if x is None else str(x) for x in names)}", names.__contains__)


def optional(check: Check) -> Check:
    """Accept `None` and all values that `check` accepts."""
    return Check(f"null or {check.description}", lambda value: value is None or check.accepts(value), check.most)


def integer_range(least: int, most: int) -> Check:
    """Accept a pair of integers `(low, high)` with `least <= low <= high <= most`."""
    accepts_one = integer(least, most).accepts

    def accepts(value: Any) -> bool:
        is_pair = isinstance(value, tuple) and len(value) == 2 and all(map(accepts_one, value))
        return is_pair and value[0] <= value[1]

    return Check(f"a pair [low, high] of integers from {least} to {most}", accepts)


BOOL = Check("true or false", lambda value: isinstance(value, bool | np.bool_))
POSITIVE = Check("a positive number", lambda value: value > 0)
POSITIVE_FINITE = Check("a positive finite number", lambda value: 0 < value < math.inf)
NOT_NEGATIVE = Check("a number >= 0", lambda value: value >= 0)
UNIT_INTERVAL = Check("a number from 0 to 1", lambda value: 0 <= value <= 1)
