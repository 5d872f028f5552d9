"""Memory layout and reduction of groups of varying size, decided here once for every aggregator.

Most aggregators are commutative monoids: `lift` turns the message of one entity into a summary, one of `REDUCTIONS`
combines summaries, and `lower` turns the summary of a whole group into a vector. Absent entities contribute the
identity, so they have exactly no influence on output and gradient. Other aggregators need the whole group: their `pool`
takes a `DenseView`, [receivers, slots, features].

Messages arrive as an irregular list with the receiver of each message (`aggregate`), or as dense slots that are not
encoded yet (`Pool`). `Pool` supports three layouts of the slots with the same result, and takes the one that was
measured to be fastest:

* streaming: one slot at a time is encoded, lifted and combined, so that the hidden activations of all slots never
  exist at once; the backward pass encodes each slot again
* dense: all slots at once, reduced along an axis; the only layout for aggregators that need the whole group
* segments: all slots as one list, reduced by segment operations

On a CPU, `Pool` processes receivers in pieces whose activations stay in the cache. See benchmarks/LOG.md for the
measurements.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxswarm.types import Entities, pytree, static

Summary = Any  # a pytree of arrays [receivers, ...]
EntityEncoder = Callable[[Float[Array, "n dim"]], tuple[Float[Array, "n width"], ...]]  # to the parts of messages
Layout = Literal["streaming", "dense", "segments"]

LOWEST = float(np.finfo(np.float32).min)  # the identity of max; finite, so that differences are not NaN
_FASTEST_LAYOUT: dict[str, Layout] = {"add": "streaming", "max": "dense", "scaled_add": "segments"}  # by reduction
_UNROLL = 10  # slots per loop iteration of the streaming layout for messages of one part; 1 for more parts
_PIECE_ELEMENTS = {"streaming": 2**16, "dense": 2**18, "segments": 2**18}  # of one array of activations


@pytree
class Segments:
    """Receivers of a list of messages, in any order.

    Only messages that are present and whose receiver is in 0 ... num_receivers - 1 are aggregated. `max_group_size`
    bounds the number of messages per receiver in a dense view (default: the length of the list); of a larger group,
    the first messages of the list are kept. `own` holds the features of the receivers themselves, for aggregators that
    use them.
    """

    receiver: Int[Array, " messages"]
    is_present: Bool[Array, " messages"]
    num_receivers: int = static()
    max_group_size: int | None = static(default=None)
    own: Float[Array, "receivers own_dim"] | None = None


@pytree
class DenseView:
    """Messages of whole groups in slots; those of absent entities are arbitrary numbers of moderate size."""

    messages: Float[Array, "receivers slots features"]
    mask: Bool[Array, "receivers slots"]
    own: Float[Array, "receivers own_dim"] | None = None


@runtime_checkable
class Monoid(Protocol):
    """Aggregator that combines the summaries of single entities.

    `lift` takes the `num_parts` arrays [entities, features] of a message and returns the summaries of groups of one
    entity each. `lower` returns the vectors [receivers, out] of groups. `reduction` is a key of `REDUCTIONS`.
    """

    num_parts: ClassVar[int]
    num_encoders: int
    reduction: ClassVar[str]
    lift: Callable[..., Summary]
    lower: Callable[[Summary], Array]


@runtime_checkable
class DenseAggregator(Protocol):
    """Aggregator that needs the whole group: `pool` returns the vectors [receivers, out] of a dense view."""

    num_parts: ClassVar[int]
    num_encoders: int
    pool: Callable[[DenseView], Array]


@runtime_checkable
class RestrictsWidth(Protocol):
    """Aggregator that works for some message widths only: `check_width` raises a `ValueError` for the others."""

    check_width: Callable[[int], None]


class Aggregator(nn.Module):
    """Base of the aggregators: a call aggregates a list of messages.

    A subclass implements `Monoid` or `DenseAggregator`, and `weights(view)`: the share of each entity in the vector of
    its group, [receivers, slots].
    """

    def __call__(
        self, messages: Float[Array, "messages features"], segments: Segments
    ) -> Float[Array, "receivers out"]:
        """Return the vector of each receiver; see `aggregate`."""
        return aggregate(self, messages, segments)


class GroupReduce(NamedTuple):
    """Sum and maximum over the entities of each receiver, and the values of receivers for each of their entities."""

    add: Callable[[Array], Array]
    max: Callable[[Array], Array]
    to_entities: Callable[[Array], Array]


class Reduction(NamedTuple):
    """Commutative combination of summaries: identity of the same shape, combination of two, reduction over groups."""

    identity: Callable[[Summary], Summary]
    combine: Callable[[Summary, Summary], Summary]
    reduce: Callable[[Summary, GroupReduce], Summary]


def _constant(value: float) -> Callable[[Summary], Summary]:
    return lambda like: jax.tree.map(lambda x: jnp.full_like(x, value), like)


def _combine_scaled(one: Summary, two: Summary) -> Summary:
    (exponent, values), (other_exponent, other_values) = one, two
    # The result exp(m) values does not depend on the choice of m, so m needs no gradient.
    top = jax.lax.stop_gradient(jnp.maximum(exponent, other_exponent))
    scale, other_scale = jnp.exp(exponent - top), jnp.exp(other_exponent - top)
    return top, jax.tree.map(lambda x, y: x * scale + y * other_scale, values, other_values)


def _reduce_scaled(summary: Summary, group: GroupReduce) -> Summary:
    exponent, values = summary
    top = jax.lax.stop_gradient(group.max(exponent))
    scale = jnp.exp(exponent - group.to_entities(top))
    return top, jax.tree.map(lambda x: group.add(x * scale), values)


REDUCTIONS = {
    "add": Reduction(
        _constant(0.0),
        lambda one, two: jax.tree.map(jnp.add, one, two),
        lambda summary, group: jax.tree.map(group.add, summary),
    ),
    "max": Reduction(
        _constant(LOWEST),
        lambda one, two: jax.tree.map(jnp.maximum, one, two),
        lambda summary, group: jax.tree.map(group.max, summary),
    ),
    # A summary (m, values) represents exp(m) values, whose sum would overflow.
    "scaled_add": Reduction(
        lambda like: (_constant(LOWEST)(like[0]), _constant(0.0)(like[1])), _combine_scaled, _reduce_scaled
    ),
}


def segments_of(mask: Bool[Array, "receivers slots"]) -> Segments:
    """Return the segments of the list of all slots, row by row."""
    num_receivers, num_slots = mask.shape
    receiver = jnp.repeat(jnp.arange(num_receivers), num_slots)
    return Segments(receiver, mask.reshape(-1), num_receivers, num_slots)  # pyright: ignore[reportArgumentType]


def is_received(segments: Segments) -> Bool[Array, " messages"]:
    """Mark messages that are present and have an existing receiver."""
    return segments.is_present & (segments.receiver >= 0) & (segments.receiver < segments.num_receivers)


def check_shape(name: str, array: Array, *shape: int | None) -> None:
    """Raise a `ValueError` unless the array has this shape; `None` stands for any size. Costs nothing once compiled."""
    chex.assert_shape(
        array,
        shape,
        custom_message=f"{name}: must have the shape {shape}, got {jnp.shape(array)}",
        include_default_message=False,
        exception_type=ValueError,
    )


def aggregate(
    aggregator: nn.Module, messages: Float[Array, "messages features"], segments: Segments
) -> Float[Array, "receivers out"]:
    """Aggregate a list of messages by receiver; a message is the concatenation of its parts.

    Raises a `ValueError` if the shapes of messages and segments do not fit, or if the aggregator is neither a `Monoid`
    nor a `DenseAggregator`.
    """
    check_shape("messages", messages, None, None)
    check_shape("segments.receiver", segments.receiver, messages.shape[0])
    check_shape("segments.is_present", segments.is_present, messages.shape[0])
    _check_own("segments.own", segments.own, segments.num_receivers)
    is_present = is_received(segments)
    messages = jnp.where(is_present[:, None], messages, 0.0)
    if not isinstance(aggregator, Monoid):
        return _pool(aggregator, dense_view(messages, segments))
    summary = _lift(aggregator, is_present, jnp.split(messages, aggregator.num_parts, axis=-1))
    return aggregator.lower(REDUCTIONS[aggregator.reduction].reduce(summary, _segment_reduce(segments)))


def aggregate_dense(aggregator: nn.Module, view: DenseView) -> Float[Array, "receivers out"]:
    """Aggregate the messages of a dense view."""
    if not isinstance(aggregator, Monoid):
        return _pool(aggregator, view)
    messages = view.messages.reshape(-1, view.messages.shape[-1])
    summary = _lift(aggregator, view.mask.reshape(-1), jnp.split(messages, aggregator.num_parts, axis=-1))
    summary = jax.tree.map(lambda x: x.reshape(*view.mask.shape, *x.shape[1:]), summary)
    return aggregator.lower(REDUCTIONS[aggregator.reduction].reduce(summary, _SLOT_REDUCE))


def _pool(aggregator: nn.Module, view: DenseView) -> Float[Array, "receivers out"]:
    if not isinstance(aggregator, DenseAggregator):
        raise ValueError(
            "aggregator: must be a module with num_parts, num_encoders, and either `pool` or `lift`, `reduction` and "
            f"`lower`, got {type(aggregator).__name__}"
        )
    return aggregator.pool(view)


def dense_view(messages: Float[Array, "messages features"], segments: Segments) -> DenseView:
    """Return the messages of each receiver, in the order of the list."""
    num_messages, num_receivers = messages.shape[0], segments.num_receivers
    num_slots = num_messages if segments.max_group_size is None else segments.max_group_size
    # Messages without a receiver are sorted to the end and dropped.
    receiver = jnp.where(is_received(segments), segments.receiver, num_receivers)
    order = jnp.argsort(receiver, stable=True)
    receiver = receiver[order]
    rank = jnp.arange(num_messages) - jnp.searchsorted(receiver, receiver)
    features = jnp.zeros((num_receivers, num_slots, messages.shape[1]), messages.dtype)
    features = features.at[receiver, rank].set(messages[order], mode="drop")
    mask = jnp.zeros((num_receivers, num_slots), bool).at[receiver, rank].set(True, mode="drop")
    return DenseView(features, mask, segments.own)


def normalized_weights(
    importance: Shaped[Array, "receivers slots features"], mask: Bool[Array, "receivers slots"]
) -> Float[Array, "receivers slots"]:
    """Return the importance over its sum over the present entities, mean over the features."""
    importance = jnp.where(mask[..., None], importance, 0).astype(jnp.float32)
    total = importance.sum(1, keepdims=True)
    return (importance / jnp.where(total > 0, total, 1.0)).mean(-1)


def _lift(monoid: Monoid, is_present: Bool[Array, " n"], parts: Sequence[Array]) -> Summary:
    """Return the summaries of single entities; those of absent entities are the identity."""
    summary = monoid.lift(*parts)

    def select(x: Array, identity: Array) -> Array:
        return jnp.where(is_present.reshape(-1, *[1] * (x.ndim - 1)), x, identity)

    return jax.tree.map(select, summary, REDUCTIONS[monoid.reduction].identity(summary))


def _segment_reduce(segments: Segments) -> GroupReduce:
    receiver, num_receivers = segments.receiver, segments.num_receivers
    return GroupReduce(
        add=lambda x: jax.ops.segment_sum(x, receiver, num_receivers),
        max=lambda x: jnp.maximum(jax.ops.segment_max(x, receiver, num_receivers), LOWEST),
        to_entities=lambda x: x.at[receiver].get(mode="fill", fill_value=0.0),
    )


_SLOT_REDUCE = GroupReduce(  # along the second axis of arrays [receivers, slots, ...]
    add=lambda x: x.sum(1),
    max=lambda x: x.max(1, initial=LOWEST),
    to_entities=lambda x: x[:, None],
)


class Pool(nn.Module):
    """Encoding of groups, and aggregation of all of them to one vector.

    Each group has an encoder that maps [n, dim] to the parts of messages, each [n, width]. The submodules may belong to
    other modules, which then hold their parameters. `layout=None` takes the fastest layout.
    """

    aggregator: nn.Module
    encoders: tuple[EntityEncoder, ...]
    width: int
    layout: Layout | None = None

    def __call__(
        self, groups: tuple[Entities, ...], own: Float[Array, "receivers own_dim"] | None = None
    ) -> Float[Array, "receivers out"]:
        """Return the vectors of the receivers of groups with features [receivers, slots, dim].

        `own` holds the features of the receivers themselves. Raises a `ValueError` if the shapes do not fit.
        """
        _check_groups(groups, own)
        is_encoded_monoid = isinstance(self.aggregator, Monoid) and self.aggregator.num_encoders > 0
        layout = self.layout or (_FASTEST_LAYOUT[self.aggregator.reduction] if is_encoded_monoid else "dense")
        num_receivers = groups[0].mask.shape[0]
        groups = _zero_absent(groups)
        num_pieces = max(-(-num_receivers // self._receivers_per_piece(layout, groups)), 1)
        if num_pieces == 1:
            return getattr(self, layout)(groups, own)

        def add_piece(self: "Pool", carry: None, piece: tuple) -> tuple[None, Array]:
            return carry, getattr(self, layout)(*piece)

        body = add_piece if layout == "streaming" else nn.remat(add_piece, prevent_cse=False)
        scan = nn.scan(body, variable_broadcast="params", split_rngs={"params": False})
        out = scan(self, None, jax.tree.map(lambda x: _split(x, num_pieces), (groups, own)))[1]
        return out.reshape(-1, out.shape[-1])[:num_receivers]

    def weights(
        self, groups: tuple[Entities, ...], own: Float[Array, "receivers own_dim"] | None = None
    ) -> tuple[Float[Array, "receivers slots"], ...]:
        """Return the share of each entity in the vector of its receiver.

        The shares of all groups sum to 1, or to 0 if no entity is present.
        """
        _check_groups(groups, own)
        weights = self.aggregator.weights(self._encode(_zero_absent(groups), own))
        return tuple(jnp.split(weights, np.cumsum([group.mask.shape[1] for group in groups])[:-1], 1))

    def streaming(self, groups: tuple[Entities, ...], own: Array | None) -> Float[Array, "receivers out"]:
        """Aggregate one slot after the other; the backward pass encodes each slot again instead of storing it."""
        del own
        monoid = self.aggregator
        assert isinstance(monoid, Monoid)
        combine = REDUCTIONS[monoid.reduction].combine

        def add_slot(encoder: EntityEncoder, summary: Summary, slot: Entities) -> tuple[Summary, None]:
            return combine(summary, _lift(monoid, slot.mask, encoder(slot.features))), None

        scan = nn.scan(
            nn.remat(add_slot, prevent_cse=False),
            variable_broadcast="params",
            split_rngs={"params": False},
            unroll=_UNROLL if monoid.num_parts == 1 else 1,
        )
        sample = monoid.lift(*[jnp.zeros((groups[0].mask.shape[0], self.width))] * monoid.num_parts)
        summary = REDUCTIONS[monoid.reduction].identity(sample)
        for encoder, group in zip(self.encoders, groups, strict=True):
            slots = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), group)
            summary = scan(encoder, summary, slots)[0]
        return monoid.lower(summary)

    def dense(self, groups: tuple[Entities, ...], own: Array | None) -> Float[Array, "receivers out"]:
        """Aggregate all slots at once along an axis."""
        return aggregate_dense(self.aggregator, self._encode(groups, own))

    def segments(self, groups: tuple[Entities, ...], own: Array | None) -> Float[Array, "receivers out"]:
        """Aggregate all slots as one list by segment operations."""
        view = self._encode(groups, own)
        segments = dataclasses.replace(segments_of(view.mask), own=own)
        return aggregate(self.aggregator, view.messages.reshape(-1, view.messages.shape[-1]), segments)

    def _encode(self, groups: tuple[Entities, ...], own: Array | None) -> DenseView:
        def encode(encoder: EntityEncoder, group: Entities) -> Array:
            messages = jnp.concatenate(encoder(group.features.reshape(-1, group.features.shape[-1])), -1)
            return messages.reshape(*group.mask.shape, messages.shape[-1])

        messages = [encode(encoder, group) for encoder, group in zip(self.encoders, groups, strict=True)]
        mask = jnp.concatenate([group.mask for group in groups], 1)
        return DenseView(jnp.concatenate(messages, 1), mask, own)

    def _receivers_per_piece(self, layout: Layout, groups: tuple[Entities, ...]) -> int:
        if jax.default_backend() != "cpu":
            return max(groups[0].mask.shape[0], 1)
        num_slots = 1 if layout == "streaming" else sum(group.mask.shape[1] for group in groups)
        return max(_PIECE_ELEMENTS[layout] // max(num_slots * self.width * self.aggregator.num_parts, 1), 1)


def _check_groups(groups: tuple[Entities, ...], own: Array | None) -> None:
    num_receivers = groups[0].mask.shape[0]
    for i, group in enumerate(groups):
        check_shape(f"groups[{i}].features", group.features, num_receivers, None, None)
        check_shape(f"groups[{i}].mask", group.mask, *group.features.shape[:2])
    _check_own("own", own, num_receivers)


def _check_own(name: str, own: Array | None, num_receivers: int) -> None:
    if own is not None:
        check_shape(name, own, num_receivers, None)


def _zero_absent(groups: tuple[Entities, ...]) -> tuple[Entities, ...]:
    """Set the features of absent entities to 0."""
    return tuple(Entities(jnp.where(x.mask[..., None], x.features, 0.0), x.mask) for x in groups)


def _split(x: Array, num_pieces: int) -> Array:
    """Split into pieces of equal length along a new first axis; zeros, absent entities, fill the last piece."""
    size = -(-x.shape[0] // num_pieces)
    padding = [(0, num_pieces * size - x.shape[0])] + [(0, 0)] * (x.ndim - 1)
    return jnp.pad(x, padding).reshape(num_pieces, size, *x.shape[1:])
