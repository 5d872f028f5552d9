"""Aggregation by self-attention."""

import math
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from jaxswarm import checks
from jaxswarm.aggregators import sets
from jaxswarm.aggregators.sets import Aggregator, DenseView
from jaxswarm.checks import require

MAX_HEADS = 64  # each head is a part of the program


class Attentive(Aggregator):
    """Multi-head self-attention over the group (Vaswani et al., 2017), a residual, then a weighted mean.

        p_hij = softmax_j (q_hi . k_hj / sqrt(d)),   y_i = x_i + W_o [sum_j p_hij v_hj]_h + b_o,   z = sum_i w_i y_i

    With `pooling="mean"` all w_i are equal, as in the thesis. With `pooling="query"`,
    w = softmax_i (q_0 . y_i / sqrt(D)), where q_0 is a linear function of the receiver's own features. Parameters and
    their initialization are those of PyTorch's `MultiheadAttention`, except that the output projection is initialized
    orthogonally with gain sqrt(2). The vector of an empty group is 0.

    Attributes:
        num_heads: The attention has this many heads, an integer >= 1 that divides the last layer width before the
            aggregation.
        residual: The output of the attention is added to the messages if true, and replaces them if false.
        pooling: The group becomes one vector by a mean with equal weights (`mean`), or by a mean whose weights depend
            on the agent's own state (`query`).
    """

    num_heads: int = 2
    residual: bool = True
    pooling: Literal["mean", "query"] = "mean"

    __no_type_check__ = True  # `__post_init__` checks the fields, with a message for users

    num_parts: ClassVar[int] = 1
    num_encoders: ClassVar[int] = 1

    def __post_init__(self) -> None:
        require(self, checks.size(1, MAX_HEADS), "num_heads")
        require(self, checks.choice(("mean", "query")), "pooling")
        require(self, checks.BOOL, "residual")
        super().__post_init__()

    def check_width(self, width: int) -> None:
        """Raise a `ValueError` unless the number of heads divides the message width."""
        if width % self.num_heads:
            raise ValueError(f"num_heads: must divide the message width {width}, got {self.num_heads}")

    def pool(self, view: DenseView) -> Float[Array, "receivers features"]:
        """Return the vector z of each receiver."""
        return self._attend(view)[0]

    def weights(self, view: DenseView) -> Float[Array, "receivers slots"]:
        """Return sum_i w_i p_hij, mean over the heads, without the contribution of entity j to the residual."""
        return jnp.stack(self._attend(view)[1]).mean(0)

    @nn.compact
    def _attend(self, view: DenseView) -> tuple[Float[Array, "receivers features"], list[Array]]:
        """Return z, and sum_i w_i p_hij of each head.

        As y is linear in the values, only one weighted mean of the x_j is projected to values per receiver and head.
        """
        x, size = view.messages, view.messages.shape[-1]
        self.check_width(size)
        W_in = self.param("in_kernel", nn.initializers.xavier_uniform(), (size, 3 * size))
        b_in = self.param("in_bias", nn.initializers.zeros, (3 * size,))
        W_o = self.param("out_kernel", nn.initializers.orthogonal(math.sqrt(2.0)), (size, size))
        b_o = self.param("out_bias", nn.initializers.zeros, (size,))
        W_q, W_k, W_v = jnp.moveaxis(W_in.reshape(size, 3, self.num_heads, -1), 0, 2)  # [heads, size, d] each
        # The bias of the keys is not used: it adds the same number to the scores of all j.
        b_q, _, b_v = b_in.reshape(3, self.num_heads, -1)

        attention = [_attention(view, *head) for head in zip(W_q, W_k, b_q, strict=True)]
        if self.pooling == "mean":
            w = view.mask / jnp.maximum(view.mask.sum(-1, keepdims=True), 1)
        else:
            w = self._query_weights(view, attention, W_v @ W_o.reshape(self.num_heads, -1, size))
        weights = [jnp.einsum("ri,rij->rj", w / total, e) for e, total in attention]
        *means, mean = jnp.moveaxis(jnp.einsum("rhj,rje->rhe", jnp.stack([*weights, w], 1), x), 1, 0)
        values = [mean_h @ W + b[None] for mean_h, W, b in zip(means, W_v, b_v, strict=True)]
        z = jnp.concatenate(values, -1) @ W_o + b_o[None]
        if self.residual:
            z = z + mean
        return jnp.where(view.mask.any(-1, keepdims=True), z, 0.0), weights

    def _query_weights(
        self, view: DenseView, attention: list, value_output: Float[Array, "heads size size"]
    ) -> Float[Array, "receivers slots"]:
        """Return the w_i of a learned query; `value_output` is W_v W_o.

        Terms of q_0 . y_i that are equal for all i are omitted.
        """
        if view.own is None:
            raise ValueError("own: must be the features of the receivers with pooling='query', got None")
        x = view.messages
        query = nn.Dense(x.shape[-1], name="query")(view.own) / math.sqrt(x.shape[-1])
        score = jnp.einsum("re,rie->ri", query, x) if self.residual else jnp.zeros(view.mask.shape)
        for (e, total), W_vo in zip(attention, value_output, strict=True):
            score = score + jnp.einsum("rij,rj->ri", e, jnp.einsum("re,rje->rj", query @ W_vo.T, x)) / total
        e, total = _exponentials(score, view.mask)
        return jnp.where(view.mask, e / total[:, None], 0.0)


def _attention(
    view: DenseView, queries: Float[Array, "size d"], keys: Float[Array, "size d"], query_bias: Float[Array, " d"]
) -> tuple[Float[Array, "receivers slots slots"], Float[Array, "receivers slots"]]:
    """Return the attention p_ij of one head as numerators and sums; see `_exponentials`."""
    x, (size, d) = view.messages, keys.shape
    scale = 1 / math.sqrt(d)

    def project(kernel: Array) -> Array:
        return x.reshape(-1, size) @ kernel

    query = (project(queries * scale) + (query_bias * scale)[None]).reshape(*x.shape[:2], d)
    key = project(keys).reshape(*x.shape[:2], d)
    return _exponentials(jnp.einsum("rid,rjd->rij", query, key), view.mask[:, None])


def _exponentials(score: Float[Array, "*n slots"], mask: Bool[Array, "*#n slots"]) -> tuple[Array, Array]:
    """Return the numerators of a softmax over the last axis, and their sums.

    The numerators of absent entities are 0 if any entity is present.
    """
    score = jnp.where(mask, score, sets.LOWEST)
    top = jax.lax.stop_gradient(score.max(-1, initial=sets.LOWEST, keepdims=True))
    e = jnp.exp(score - top)
    return e, e.sum(-1)
