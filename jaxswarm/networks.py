"""Networks: an encoder per group, an aggregator, a decoder, and the heads of actor and critic."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from jaxswarm import sets
from jaxswarm.aggregators import Mean
from jaxswarm.distributions import Policy, gaussian
from jaxswarm.types import Entities, Observation


def leaky_relu(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """x, or x / 100 where it is not positive; so is the slope at 0 (`jax.nn.leaky_relu` has 1 there), as in PyTorch."""
    return jnp.where(x > 0, x, 0.01 * x)


ACTIVATIONS = {"leaky_relu": leaky_relu, "relu": nn.relu, "tanh": nn.tanh}
_HIDDEN_INIT = nn.initializers.orthogonal(math.sqrt(2.0))


class Encoder(nn.Module):
    """Dense layers, each followed by the activation, the last one included.

    The last layer yields the parts of a message by one matrix product each, initialised as one matrix.
    """

    widths: tuple[int, ...]
    activation: str
    num_parts: int = 1

    @nn.compact
    def __call__(self, features: Float[Array, "n dim"]) -> tuple[Float[Array, "n width"], ...]:
        """Encodes entities to the parts of their messages."""
        activation = ACTIVATIONS[self.activation]
        x = features
        for width in self.widths[:-1]:
            x = activation(nn.Dense(width, kernel_init=_HIDDEN_INIT)(x))
        size = self.num_parts * self.widths[-1]
        kernel = self.param("kernel", _HIDDEN_INIT, (x.shape[-1], size))
        bias = self.param("bias", nn.initializers.zeros, (size,))
        parts = zip(jnp.split(kernel, self.num_parts, 1), jnp.split(bias, self.num_parts), strict=True)
        return tuple(activation(x @ k + b[None]) for k, b in parts)


class Tower(nn.Module):
    """Encodes and aggregates every group, then decodes [own, aggregate of each group in order of name].

    With `latent_space="shared"` the groups keep their encoders but are aggregated together, into one vector.
    """

    encoder: tuple[int, ...]
    decoder: tuple[int, ...]
    activation: str
    aggregator: Any
    latent_space: str

    @nn.compact
    def __call__(self, own: Float[Array, "n own_dim"], groups: dict[str, Entities]) -> Float[Array, "n latent"]:
        """Latent vector of each receiver."""
        names = sorted(groups)
        encoders = {
            name: Encoder(self.encoder, self.activation, self.aggregator.num_parts, name=f"{name}_encoder")
            for name in names
        }
        pools = {"groups": names} if self.latent_space == "shared" else {name: [name] for name in names}
        x = [own]
        for pool, members in pools.items():
            aggregator = self.aggregator.copy(name=f"{pool}_aggregator")
            x.append(
                sets.encode_and_reduce(
                    aggregator, [encoders[m] for m in members], [groups[m] for m in members], self.encoder[-1]
                )
            )
        latent = jnp.concatenate(x, -1)
        for width in self.decoder:
            latent = ACTIVATIONS[self.activation](nn.Dense(width, kernel_init=_HIDDEN_INIT)(latent))
        return latent


class ActorCritic(nn.Module):
    """Actor and critic as two separate towers, shared by all agents.

    `encoder` and `decoder` are layer widths; the last encoder width is the size of an aggregate. The log standard
    deviation of actions is one parameter, the same in all states, or with `std="state"` a second head of the actor.
    Initialisation: orthogonal with gain sqrt(2) inside, 0.01 for the action mean and for the head of the log standard
    deviation, 1 for the value, shared log standard deviation 0.
    """

    encoder: tuple[int, ...] = (64,)
    decoder: tuple[int, ...] = (64,)
    activation: Literal["leaky_relu", "relu", "tanh"] = "leaky_relu"
    aggregator: nn.Module = Mean()
    latent_space: Literal["separate", "shared"] = "separate"
    std: Literal["shared", "state"] = "shared"
    action_dim: int = 2

    def setup(self) -> None:  # noqa: D102
        tower = partial(Tower, self.encoder, self.decoder, self.activation, self.aggregator, self.latent_space)
        self.actor = tower()
        self.critic = tower()
        self.action_mean = nn.Dense(self.action_dim, kernel_init=nn.initializers.orthogonal(0.01))
        self.value_head = nn.Dense(1, kernel_init=nn.initializers.orthogonal(1.0))
        if self.std == "state":
            self.action_log_std = nn.Dense(self.action_dim, kernel_init=nn.initializers.orthogonal(0.01))
        else:
            self.log_std = self.param("log_std", nn.initializers.zeros, (self.action_dim,))

    def __call__(self, obs: Observation) -> tuple[Policy, Float[Array, "*receivers"]]:
        """Policy and value of every receiver; `obs` may have any leading axes."""
        return self.policy(obs), self.value(obs)

    def policy(self, obs: Observation) -> Policy:
        """Action distribution of every receiver."""
        latent = self.actor(*_flat(obs))
        mean = self.action_mean(latent).reshape(*obs.own.shape[:-1], self.action_dim)
        if self.std == "state":
            return gaussian(mean, self.action_log_std(latent).reshape(mean.shape))
        return gaussian(mean, self.log_std.reshape([1] * (mean.ndim - 1) + [-1]))

    def value(self, obs: Observation) -> Float[Array, "*receivers"]:
        """Value estimate of every receiver."""
        return self.value_head(self.critic(*_flat(obs))).reshape(obs.own.shape[:-1])


def map_log_std(function: Callable[[Array], Array], params: Any) -> Any:
    """The parameters of an `ActorCritic` with `std="shared"`, with another log standard deviation."""
    return params | {"params": params["params"] | {"log_std": function(params["params"]["log_std"])}}


def _flat(obs: Observation) -> tuple[Float[Array, "n own_dim"], dict[str, Entities]]:
    """All receivers in one leading axis."""

    def merge(group: Entities) -> Entities:
        slots, dim = group.features.shape[-2:]
        return Entities(group.features.reshape(-1, slots, dim), group.mask.reshape(-1, slots))

    return obs.own.reshape(-1, obs.own.shape[-1]), {name: merge(group) for name, group in obs.groups.items()}
