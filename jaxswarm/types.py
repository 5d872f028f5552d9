"""Data types that all modules share."""

import dataclasses
from typing import Any, NamedTuple, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Key = jax.Array  # a typed PRNG key
Metrics = dict[str, Array]  # a flat dict of scalars
T = TypeVar("T")


class Comparable(NamedTuple):
    """Metric that compares runs of a task if some settings differ between them.

    A task lists such metrics in the class attribute `comparable_metrics`, the best one first. `settings` are the fields
    of the task that change the scale of the return, but not that of the metric.
    """

    metric: str
    settings: tuple[str, ...]
    is_higher_better: bool = False


def static(*, default: Any = dataclasses.MISSING) -> Any:
    """Declare a static field of a `pytree`: it determines shapes or the program and is not a leaf."""
    return dataclasses.field(default=default, metadata={"static": True})


@dataclass_transform(field_specifiers=(static,), frozen_default=True)
def pytree(cls: type[T]) -> type[T]:
    """Turn a class into a frozen dataclass that is a pytree and has a `replace` method.

    Fields declared with `static()` belong to the structure of the pytree; all other fields are leaves.
    `__post_init__` may check numbers: it runs when user code creates a value. It does not run when JAX rebuilds
    a value with other leaves (tracers, shapes, axis numbers, `None`). Run-time type checkers skip the constructor.
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


def clip_action(action: Float[Array, "*agents action_dim"]) -> Float[Array, "*agents action_dim"]:
    """Clip actions to the action bounds of all tasks, which are -1 and 1 in every dimension."""
    return jnp.clip(action, -1.0, 1.0)


@pytree
class Entities:
    """One group of perceived entities for each receiving agent.

    Features in masked slots are arbitrary but finite.
    """

    features: Float[Array, "*receivers slots dim"]
    mask: Bool[Array, "*receivers slots"]  # true for slots that hold an entity


@pytree
class Observation:
    """Observation of each agent: features of its own state, and named groups of entities in arbitrary order."""

    own: Float[Array, "*receivers own_dim"]
    groups: dict[str, Entities]
    mask: Bool[Array, "*receivers"] | None = None  # true for active agents, others must be ignored; None: all active


@pytree
class Step:
    """Outcome of one step of one environment; all agents share the reward."""

    reward: Float[Array, ""]
    terminated: Bool[Array, ""]  # the task has ended: the value after this step is 0
    truncated: Bool[Array, ""]  # the time limit ended the episode: its final state still has a value
    metrics: Metrics
