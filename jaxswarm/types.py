"""The few data types that every floor shares."""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax
from jaxtyping import Array, Bool, Float

Key = jax.Array  # a typed PRNG key
Metrics = dict[str, Array]  # a flat dict of scalars
T = TypeVar("T")


def static(*, default: Any = dataclasses.MISSING) -> Any:
    """A dataclass field that fixes a shape or a program: part of the tree's structure, not a leaf."""
    return dataclasses.field(default=default, metadata={"static": True})


@dataclass_transform(field_specifiers=(static,), frozen_default=True)
def pytree(cls: type[T]) -> type[T]:
    """Frozen dataclass that is a pytree, with `.replace`; fields made by `static()` are not leaves.

    `__post_init__` runs where somebody makes a value, not where JAX rebuilds one with leaves of its own kinds (tracers,
    shapes, axis numbers, `None`), so it may check numbers. Run-time type checkers leave the constructor alone.
    """
    cls = dataclasses.dataclass(frozen=True)(cls)
    cls.replace = dataclasses.replace  # pyright: ignore[reportAttributeAccessIssue]
    cls.__no_type_check__ = True  # pyright: ignore[reportAttributeAccessIssue]
    fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
    leaves = [field.name for field in fields if not field.metadata.get("static")]
    statics = [field.name for field in fields if field.metadata.get("static")]

    def flatten(node: T) -> tuple:
        return [getattr(node, name) for name in leaves], tuple(getattr(node, name) for name in statics)

    def flatten_with_keys(node: T) -> tuple:
        children, structure = flatten(node)
        return list(zip(map(jax.tree_util.GetAttrKey, leaves), children, strict=True)), structure

    def unflatten(structure: Any, children: Any) -> T:
        node = object.__new__(cls)
        for name, value in zip((*leaves, *statics), (*children, *structure), strict=True):
            object.__setattr__(node, name, value)
        return node

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


@pytree
class Entities:
    """A group of perceived entities, by receiver; absent ones are masked, their features arbitrary but finite."""

    features: Float[Array, "*receivers slots dim"]
    mask: Bool[Array, "*receivers slots"]


@pytree
class Observation:
    """What agents perceive: their own state, and named groups of entities in no particular order."""

    own: Float[Array, "*receivers own_dim"]
    groups: dict[str, Entities]
    mask: Bool[Array, "*receivers"] | None = None  # agents that exist, the others are to be ignored; None: all do


@pytree
class Step:
    """Outcome of one step of one world; the reward is common to all agents."""

    reward: Float[Array, ""]
    terminated: Bool[Array, ""]  # the task is over: nothing is to be had after this step
    truncated: Bool[Array, ""]  # the time limit cut the episode: its state still has a value
    metrics: Metrics
