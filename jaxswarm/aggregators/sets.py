"""Groups of varying size: how messages are laid out and reduced, decided here once for every aggregator.

Most aggregators are commutative monoids: `lift` turns the message of one entity into a summary, summaries are combined
by one of `REDUCTIONS`, and `lower` turns the summary of a whole group into a vector. Absent entities contribute the
identity, so they have exactly no influence on output and gradient. The others see a group as a whole: `pool` takes its
`DenseView`, [receivers, slots, features].

Messages arrive as an irregular list with the receiver of each (`aggregate`), or as dense slots still to be encoded
(`Pool`). Slots can be laid out in three ways, with the same result; `Pool` takes the one that was fastest:

* streaming: one slot at a time is encoded, lifted and combined, so that the hidden activations of all slots never
  exist at once; the backward pass encodes each slot again
* dense: all slots at once, reduced along an axis; the only one that gives a dense view
* segments: all slots as one list, reduced by segment operations

On a CPU, receivers are taken in pieces whose activations stay in the cache. What was measured: benchmarks/LOG.md.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxswarm.types import Entities, pytree, static

Summary = Any  # a pytree of arrays [receivers, ...]
Layout = Literal["streaming", "dense", "segments"]

LOWEST = float(np.finfo(np.float32).min)  # the identity of max; finite, so that differences are numbers
_FASTEST: dict[str, Layout] = {"add": "streaming", "max": "dense", "scaled_add": "segments"}  # by reduction
_UNROLL = 10  # slots per loop iteration of the streaming layout, if a message has one part; of more, one slot
_PIECE = {"streaming": 2**16, "dense": 2**18, "segments": 2**18}  # numbers in one array of activations


@pytree
class Segments:
    """The receiver of each message of a list, in any order; messages that are not present do not count.

    Neither do those with a receiver outside of 0 ... num_receivers - 1. `max_group_size` bounds the messages of one
    receiver where a dense view is needed (by default, all may have the same); of more, the first of the list count.
    `own` is what receivers know of themselves, for aggregators that ask for it.
    """

    receiver: Int[Array, " messages"]
    is_present: Bool[Array, " messages"]
    num_receivers: int = static()
    max_group_size: int | None = static(default=None)
    own: Float[Array, "receivers own_dim"] | None = None


@pytree
class DenseView:
    """Whole groups side by side; the messages of absent entities are arbitrary numbers of moderate size."""

    messages: Float[Array, "receivers slots features"]
    mask: Bool[Array, "receivers slots"]
    own: Float[Array, "receivers own_dim"] | None = None


@runtime_checkable
class Monoid(Protocol):
    """What a reduction provides.

    `lift` takes the `num_parts` arrays [entities, features] of which a message consists, and gives the summaries of
    groups of one entity each; `lower` gives the vectors [receivers, out] that stand for groups. `reduction` is a name
    in `REDUCTIONS`.
    """

    num_parts: ClassVar[int]
    num_encoders: int
    reduction: ClassVar[str]
    lift: Callable[..., Summary]
    lower: Callable[[Summary], Array]


class GroupReduce(NamedTuple):
    """Sum and maximum over the entities of each receiver, and back from receivers to their entities."""

    add: Callable[[Array], Array]
    max: Callable[[Array], Array]
    spread: Callable[[Array], Array]


class Reduction(NamedTuple):
    """A commutative way to combine summaries: its identity in their shape, for two of them, and over many."""

    identity: Callable[[Summary], Summary]
    combine: Callable[[Summary, Summary], Summary]
    reduce: Callable[[Summary, GroupReduce], Summary]


def _constant(value: float) -> Callable[[Summary], Summary]:
    return lambda like: jax.tree.map(lambda x: jnp.full_like(x, value), like)


def _combine_scaled(one: Summary, two: Summary) -> Summary:
    (exponent, values), (other_exponent, other_values) = one, two
    top = jax.lax.stop_gradient(jnp.maximum(exponent, other_exponent))  # any number gives the same exp(m) values
    scale, other_scale = jnp.exp(exponent - top), jnp.exp(other_exponent - top)
    return top, jax.tree.map(lambda x, y: x * scale + y * other_scale, values, other_values)


def _reduce_scaled(summary: Summary, over: GroupReduce) -> Summary:
    exponent, values = summary
    top = jax.lax.stop_gradient(over.max(exponent))
    scale = jnp.exp(exponent - over.spread(top))
    return top, jax.tree.map(lambda x: over.add(x * scale), values)


REDUCTIONS = {
    "add": Reduction(
        _constant(0.0),
        lambda one, two: jax.tree.map(jnp.add, one, two),
        lambda summary, over: jax.tree.map(over.add, summary),
    ),
    "max": Reduction(
        _constant(LOWEST),
        lambda one, two: jax.tree.map(jnp.maximum, one, two),
        lambda summary, over: jax.tree.map(over.max, summary),
    ),
    # (m, values) stands for exp(m) values, whose sum would overflow
    "scaled_add": Reduction(
        lambda like: (_constant(LOWEST)(like[0]), _constant(0.0)(like[1])), _combine_scaled, _reduce_scaled
    ),
}


def segments_of(mask: Bool[Array, "receivers slots"]) -> Segments:
    """The list of all slots, row by row."""
    num_receivers, num_slots = mask.shape
    receiver = jnp.repeat(jnp.arange(num_receivers), num_slots)
    return Segments(receiver, mask.reshape(-1), num_receivers, num_slots)  # pyright: ignore[reportArgumentType]


def counts(segments: Segments) -> Bool[Array, " messages"]:
    """Whether a message is present and has a receiver."""
    return segments.is_present & (segments.receiver >= 0) & (segments.receiver < segments.num_receivers)


def aggregate(
    aggregator: Any, messages: Float[Array, "messages features"], segments: Segments
) -> Float[Array, "receivers out"]:
    """Aggregates a list of messages by receiver; a message is the concatenation of its parts."""
    is_present = counts(segments)
    messages = jnp.where(is_present[:, None], messages, 0.0)
    if not isinstance(aggregator, Monoid):
        return aggregator.pool(dense_view(messages, segments))
    summary = _lift(aggregator, is_present, jnp.split(messages, aggregator.num_parts, axis=-1))
    return aggregator.lower(REDUCTIONS[aggregator.reduction].reduce(summary, _over_segments(segments)))


def aggregate_dense(aggregator: Any, view: DenseView) -> Float[Array, "receivers out"]:
    """Aggregates the messages of a dense view."""
    if not isinstance(aggregator, Monoid):
        return aggregator.pool(view)
    messages = view.messages.reshape(-1, view.messages.shape[-1])
    summary = _lift(aggregator, view.mask.reshape(-1), jnp.split(messages, aggregator.num_parts, axis=-1))
    summary = jax.tree.map(lambda x: x.reshape(*view.mask.shape, *x.shape[1:]), summary)
    return aggregator.lower(REDUCTIONS[aggregator.reduction].reduce(summary, _OVER_SLOTS))


def dense_view(messages: Float[Array, "messages features"], segments: Segments) -> DenseView:
    """The messages of each receiver, in the order of the list."""
    num_messages, num_receivers = messages.shape[0], segments.num_receivers
    num_slots = num_messages if segments.max_group_size is None else segments.max_group_size
    receiver = jnp.where(counts(segments), segments.receiver, num_receivers)  # the others are sorted to the end
    order = jnp.argsort(receiver, stable=True)
    receiver = receiver[order]
    rank = jnp.arange(num_messages) - jnp.searchsorted(receiver, receiver)
    features = jnp.zeros((num_receivers, num_slots, messages.shape[1]), messages.dtype)
    features = features.at[receiver, rank].set(messages[order], mode="drop")
    mask = jnp.zeros((num_receivers, num_slots), bool).at[receiver, rank].set(True, mode="drop")
    return DenseView(features, mask, segments.own)


def shares(
    importance: Shaped[Array, "receivers slots features"], mask: Bool[Array, "receivers slots"]
) -> Float[Array, "receivers slots"]:
    """Importance over its sum over the entities that are present, mean over the features."""
    importance = jnp.where(mask[..., None], importance, 0).astype(jnp.float32)
    total = importance.sum(1, keepdims=True)
    return (importance / jnp.where(total > 0, total, 1.0)).mean(-1)


def _lift(monoid: Monoid, is_present: Bool[Array, " n"], parts: Sequence[Array]) -> Summary:
    """Summaries of single entities; those of absent ones are the identity."""
    summary = monoid.lift(*parts)

    def select(x: Array, identity: Array) -> Array:
        return jnp.where(is_present.reshape(-1, *[1] * (x.ndim - 1)), x, identity)

    return jax.tree.map(select, summary, REDUCTIONS[monoid.reduction].identity(summary))


def _over_segments(segments: Segments) -> GroupReduce:
    receiver, num_receivers = segments.receiver, segments.num_receivers
    return GroupReduce(
        add=lambda x: jax.ops.segment_sum(x, receiver, num_receivers),
        max=lambda x: jnp.maximum(jax.ops.segment_max(x, receiver, num_receivers), LOWEST),
        spread=lambda x: x.at[receiver].get(mode="fill", fill_value=0.0),
    )


_OVER_SLOTS = GroupReduce(  # the second axis of arrays [receivers, slots, ...]
    add=lambda x: x.sum(1),
    max=lambda x: x.max(1, initial=LOWEST),
    spread=lambda x: x[:, None],
)


class Pool(nn.Module):
    """Encodes groups and aggregates all of them to one vector, in the layout that suits.

    There is an encoder for each group; it maps [n, dim] to the parts of messages, each [n, width]. The modules may
    belong to others, which then hold their parameters. Without a `layout` the fastest one is taken.
    """

    aggregator: Any
    encoders: tuple[nn.Module, ...]
    width: int
    layout: Layout | None = None

    def __call__(
        self, groups: tuple[Entities, ...], own: Float[Array, "receivers own_dim"] | None = None
    ) -> Float[Array, "receivers out"]:
        """Vectors of the receivers of groups with features [receivers, slots, dim]; `own` is what they know."""
        streams = isinstance(self.aggregator, Monoid) and self.aggregator.num_encoders > 0
        layout = self.layout or (_FASTEST[self.aggregator.reduction] if streams else "dense")
        num_receivers = groups[0].mask.shape[0]
        groups = _zero_absent(groups)
        num_pieces = max(-(-num_receivers // self._piece_size(layout, groups)), 1)
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
        """The share of each entity in the vector of its receiver; over all groups these sum to 1, or 0 without any."""
        weights = self.aggregator.weights(self._encode(_zero_absent(groups), own))
        return tuple(jnp.split(weights, np.cumsum([group.mask.shape[1] for group in groups])[:-1], 1))

    def streaming(self, groups: tuple[Entities, ...], own: Array | None) -> Float[Array, "receivers out"]:
        """One slot after the other; the backward pass encodes each again instead of storing it."""
        del own
        monoid: Monoid = self.aggregator
        combine = REDUCTIONS[monoid.reduction].combine

        def add_slot(encoder: nn.Module, summary: Summary, slot: Entities) -> tuple[Summary, None]:
            parts = encoder(slot.features)  # pyright: ignore[reportCallIssue]
            return combine(summary, _lift(monoid, slot.mask, parts)), None

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
        """All slots at once, reduced along an axis."""
        return aggregate_dense(self.aggregator, self._encode(groups, own))

    def segments(self, groups: tuple[Entities, ...], own: Array | None) -> Float[Array, "receivers out"]:
        """All slots as one list, reduced by segment operations."""
        view = self._encode(groups, own)
        segments: Any = segments_of(view.mask)
        messages = view.messages.reshape(-1, view.messages.shape[-1])
        return aggregate(self.aggregator, messages, segments.replace(own=own))

    def _encode(self, groups: tuple[Entities, ...], own: Array | None) -> DenseView:
        def encode(encoder: Any, group: Entities) -> Array:
            messages = jnp.concatenate(encoder(group.features.reshape(-1, group.features.shape[-1])), -1)
            return messages.reshape(*group.mask.shape, messages.shape[-1])

        messages = [encode(encoder, group) for encoder, group in zip(self.encoders, groups, strict=True)]
        mask = jnp.concatenate([group.mask for group in groups], 1)
        return DenseView(jnp.concatenate(messages, 1), mask, own)

    def _piece_size(self, layout: Layout, groups: tuple[Entities, ...]) -> int:
        """How many receivers are taken at once."""
        if jax.default_backend() != "cpu":
            return max(groups[0].mask.shape[0], 1)
        num_slots = 1 if layout == "streaming" else sum(group.mask.shape[1] for group in groups)
        return max(_PIECE[layout] // max(num_slots * self.width * self.aggregator.num_parts, 1), 1)


def _zero_absent(groups: tuple[Entities, ...]) -> tuple[Entities, ...]:
    """With the features of absent entities 0."""
    return tuple(Entities(jnp.where(x.mask[..., None], x.features, 0.0), x.mask) for x in groups)


def _split(x: Array, num_pieces: int) -> Array:
    """Pieces of equal length along a new first axis, the last one filled with zeros: absent entities."""
    size = -(-x.shape[0] // num_pieces)
    padding = [(0, num_pieces * size - x.shape[0])] + [(0, 0)] * (x.ndim - 1)
    return jnp.pad(x, padding).reshape(num_pieces, size, *x.shape[1:])
