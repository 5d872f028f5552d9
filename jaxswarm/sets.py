"""Groups of varying size: how messages are laid out and reduced, decided here once for every aggregator.

A reduction is a commutative monoid: `lift` turns the message of one entity into a summary, summaries are combined by
`reduction` (`"add"` or `"max"`), and `lower` turns the summary of a whole group into a vector. Absent entities
contribute the identity, so they have exactly no influence on output and gradient.

Two layouts give the same result: a flat list of messages with the receiver of each (`reduce_segments`), and dense slots
that are encoded, lifted and combined one slot at a time (`encode_and_reduce`), so that the hidden activations of all
slots never exist at once. The second made forward and gradient of an encoder 3 to 8 times faster on CPU.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from jaxswarm.types import Entities, pytree, static

Summary = Any  # a pytree of arrays [receivers, ...]

_IDENTITY = {"add": 0.0, "max": -jnp.inf}
_COMBINE = {"add": jnp.add, "max": jnp.maximum}
_SEGMENT = {"add": jax.ops.segment_sum, "max": jax.ops.segment_max}
_UNROLL = 10  # slots per loop iteration of the streaming layout; measured on CPU, see benchmarks/LOG.md


@runtime_checkable
class Monoid(Protocol):
    """What a reduction provides.

    `lift` takes the `num_parts` arrays [entities, features] of which a message consists, and gives the summaries of
    groups of one entity each; `lower` gives the vectors [receivers, out] that stand for groups.
    """

    num_parts: ClassVar[int]
    reduction: ClassVar[str]
    lift: Callable[..., Summary]
    lower: Callable[[Summary], Array]


@pytree
class Segments:
    """The receiver of each message of a flat list, in any order; messages that are not present do not count."""

    receiver: Int[Array, " messages"]
    is_present: Bool[Array, " messages"]
    num_receivers: int = static()


def segments_of(mask: Bool[Array, "receivers slots"]) -> Segments:
    """The flat list of all slots, row by row."""
    num_receivers, num_slots = mask.shape
    return Segments(jnp.repeat(jnp.arange(num_receivers), num_slots), mask.reshape(-1), num_receivers)  # pyright: ignore


def _mask(monoid: Monoid, is_present: Bool[Array, " n"], summary: Summary) -> Summary:
    """Replaces the summaries of absent entities by the identity."""

    def select(x: Array) -> Array:
        return jnp.where(is_present.reshape(-1, *[1] * (x.ndim - 1)), x, _IDENTITY[monoid.reduction])

    return jax.tree.map(select, summary)


def reduce_segments(
    monoid: Monoid, messages: Float[Array, "messages features"], segments: Segments
) -> Float[Array, "receivers out"]:
    """Aggregates a flat list of messages by receiver; a message is the concatenation of its parts."""
    summary = _mask(monoid, segments.is_present, monoid.lift(*jnp.split(messages, monoid.num_parts, axis=-1)))
    segment_reduce = _SEGMENT[monoid.reduction]
    return monoid.lower(jax.tree.map(lambda x: segment_reduce(x, segments.receiver, segments.num_receivers), summary))


def encode_and_reduce(
    monoid: Monoid, encoders: Sequence[nn.Module], groups: Sequence[Entities], width: int
) -> Float[Array, "receivers out"]:
    """Encodes each group (features [receivers, slots, dim]) with its encoder and reduces all of them to one vector.

    An encoder maps [receivers, dim] to `num_parts` arrays [receivers, width].
    """
    num_receivers = groups[0].mask.shape[0]
    sample = monoid.lift(*[jnp.zeros((num_receivers, width))] * monoid.num_parts)
    summary = jax.tree.map(lambda x: jnp.full_like(x, _IDENTITY[monoid.reduction]), sample)
    for encoder, group in zip(encoders, groups, strict=True):
        summary = _stream(monoid, encoder, group, summary)
    return monoid.lower(summary)


def _stream(monoid: Monoid, encoder: nn.Module, group: Entities, summary: Summary) -> Summary:
    """Adds a group to a summary, slot by slot; the backward pass encodes each slot again instead of storing it."""
    combine: Callable = _COMBINE[monoid.reduction]

    def add_slot(encoder: nn.Module, summary: Summary, slot: Entities) -> tuple[Summary, None]:
        lifted = _mask(monoid, slot.mask, monoid.lift(*encoder(slot.features)))  # pyright: ignore[reportCallIssue]
        return jax.tree.map(combine, summary, lifted), None

    scan = nn.scan(
        nn.remat(add_slot, prevent_cse=False),
        variable_broadcast="params",
        split_rngs={"params": False},
        unroll=_UNROLL,
    )
    slots = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), group)
    return scan(encoder, summary, slots)[0]
