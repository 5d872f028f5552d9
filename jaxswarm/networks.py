"""Networks: an encoder per group, an aggregator, a decoder, and the heads of actor and critic."""

import math
from collections.abc import Callable
from typing import Any, Literal

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from jaxswarm import checks
from jaxswarm.aggregators import Mean, sets
from jaxswarm.checks import require
from jaxswarm.distributions import Policy, gaussian
from jaxswarm.types import Entities, Observation


def leaky_relu(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """x, or x / 100 where it is not positive; so is the slope at 0 (`jax.nn.leaky_relu` has 1 there), as in PyTorch."""
    return jnp.where(x > 0, x, 0.01 * x)


ACTIVATIONS = {"leaky_relu": leaky_relu, "relu": nn.relu, "tanh": nn.tanh}
_HIDDEN_INIT = nn.initializers.orthogonal(math.sqrt(2.0))


class Encoder(nn.Module):
    """Dense layers, each followed by the activation, the last one unless it `ends_linear`; then any second stage.

    The last layer yields the parts of a message by one matrix product each, initialized as one matrix.
    """

    widths: tuple[int, ...]
    activation: str
    num_parts: int = 1
    second_stage: nn.Module | None = None
    ends_linear: bool = False

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
        outputs = tuple(x @ k + b[None] for k, b in parts)
        if not self.ends_linear:
            outputs = tuple(map(activation, outputs))
        return outputs if self.second_stage is None else self.second_stage(*outputs)


class ParallelEncoders(nn.Module):
    """Encoders of the same entities, one for each part of a message; with none, the features are the message."""

    encoders: tuple[nn.Module, ...]

    def __call__(self, features: Float[Array, "n dim"]) -> tuple[Float[Array, "n width"], ...]:
        """The parts one after the other."""
        encoders: tuple[Any, ...] = self.encoders
        return tuple(part for encoder in encoders for part in encoder(features)) if encoders else (features,)


class Tower(nn.Module):
    """Encodes and aggregates every group, then decodes [own, aggregate of each group in order of name].

    With `latent_space="shared"` the groups keep their encoders but are aggregated together, into one vector.
    `shared_encoder` are layers after the encoder of each group, the same for all groups.
    """

    encoder: tuple[int, ...]
    shared_encoder: tuple[int, ...]
    decoder: tuple[int, ...]
    activation: str
    aggregator: Any
    latent_space: str
    linear_output_layers: bool

    def __call__(self, own: Float[Array, "n own_dim"], groups: dict[str, Entities]) -> Float[Array, "n latent"]:
        """Latent vector of each receiver."""
        return self._compute(own, groups)

    def weights(
        self, own: Float[Array, "n own_dim"], groups: dict[str, Entities]
    ) -> dict[str, Float[Array, "n slots"]]:
        """The share that each entity has in the aggregate of its group."""
        return self._compute(own, groups, "weights")

    @nn.compact
    def _compute(self, own: Array, groups: dict[str, Entities], wanted: Literal["latent", "weights"] = "latent") -> Any:
        names = sorted(groups)
        if self.latent_space == "shared" and self.aggregator.num_encoders == 0 and len(names) > 1:
            raise ValueError(
                f"latent_space: must be separate for the groups {', '.join(names)}, got 'shared'; "
                f"{type(self.aggregator).__name__} aggregates raw features, whose sizes differ between groups"
            )
        encoders = self._encoders(names)
        pools = {"groups": names} if self.latent_space == "shared" else {name: [name] for name in names}
        x, weights = [own], {}
        for name, members in pools.items():
            aggregator = self.aggregator.copy(name=f"{name}_aggregator")
            inputs = tuple(groups[m] for m in members)
            is_encoded = self.aggregator.num_encoders > 0
            width = (*self.encoder, *self.shared_encoder)[-1] if is_encoded else inputs[0].features.shape[-1]
            pool = sets.Pool(aggregator, tuple(encoders[m] for m in members), width)
            if wanted == "weights":
                weights |= dict(zip(members, pool.weights(inputs, own), strict=True))
            else:
                x.append(pool(inputs, own))
        if wanted == "weights":
            return weights
        latent = jnp.concatenate(x, -1)
        for i, width in enumerate(self.decoder, 1):
            latent = nn.Dense(width, kernel_init=_HIDDEN_INIT)(latent)
            if i < len(self.decoder) or not self.linear_output_layers:
                latent = ACTIVATIONS[self.activation](latent)
        return latent

    def _encoders(self, names: list[str]) -> dict[str, nn.Module]:
        """One for each group; with several encoders for the parts of a message, all but the first have a number."""
        numbers = ["", *(f"_{i}" for i in range(1, self.aggregator.num_encoders))][: self.aggregator.num_encoders]
        num_parts = self.aggregator.num_parts // max(len(numbers), 1)

        def encoder(widths: tuple[int, ...], name: str, second_stage: nn.Module | None = None) -> nn.Module:
            size = 1 if second_stage else num_parts
            ends_linear = self.linear_output_layers and second_stage is None
            return Encoder(widths, self.activation, size, second_stage, ends_linear, name=name)

        shared = {n: encoder(self.shared_encoder, f"second_stage{n}") if self.shared_encoder else None for n in numbers}
        return {
            m: ParallelEncoders(tuple(encoder(self.encoder, f"{m}_encoder{n}", shared[n]) for n in numbers))
            for m in names
        }


class ActorCritic(nn.Module):
    """Actor and critic as two separate towers, shared by all agents.

    `encoder`, `shared_encoder` and `decoder` are layer widths: of each group's own encoder, of layers after it that all
    groups share, and of what follows the aggregates, whose size is the last width before. The log standard deviation
    of actions is one parameter, the same in all states, or with `std="state"` a second head of the actor. All layers
    end with the activation, as in the thesis, or with `linear_output_layers` all but the last before an aggregator and
    the last of the decoder.
    Initialization: orthogonal with gain sqrt(2) inside, 0.01 for the action mean and for the head of the log standard
    deviation, 1 for the value, shared log standard deviation 0.
    """

    encoder: tuple[int, ...] = (64,)
    decoder: tuple[int, ...] = (64,)
    shared_encoder: tuple[int, ...] = ()
    activation: Literal["leaky_relu", "relu", "tanh"] = "leaky_relu"
    aggregator: nn.Module = Mean()
    latent_space: Literal["separate", "shared"] = "separate"
    std: Literal["shared", "state"] = "shared"
    linear_output_layers: bool = False
    action_dim: int = 2

    __no_type_check__ = True  # checked below, with a message for users

    def __post_init__(self) -> None:
        require(self, checks.Check("an aggregator, like Mean()", lambda x: isinstance(x, nn.Module)), "aggregator")
        require(self, checks.Check("a tuple of integers >= 1", _is_widths), "encoder", "shared_encoder", "decoder")
        require(self, checks.Check("a list of at least one layer, like [64]", lambda x: len(x) > 0), "encoder")
        require(self, checks.choice(ACTIVATIONS), "activation")
        require(self, checks.choice(("separate", "shared")), "latent_space")
        require(self, checks.choice(("shared", "state")), "std")
        require(self, checks.BOOL, "linear_output_layers")
        require(self, checks.integer(1), "action_dim")
        if hasattr(self.aggregator, "check_width"):
            self.aggregator.check_width((*self.encoder, *self.shared_encoder)[-1])
        super().__post_init__()

    def setup(self) -> None:  # noqa: D102
        layers = (self.encoder, self.shared_encoder, self.decoder, self.activation)
        how = (self.aggregator, self.latent_space, self.linear_output_layers)
        self.actor, self.critic = (Tower(*layers, *how) for _ in range(2))
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

    def weights(self, obs: Observation) -> dict[str, Float[Array, "*receivers slots"]]:
        """The share that each entity has in what the actor aggregates; see the `weights` of the aggregator.

        Present entities of one group sum to 1, with `latent_space="shared"` those of all groups; absent ones have 0.
        """
        weights = self.actor.weights(*_flat(obs))
        return {name: x.reshape(*obs.own.shape[:-1], x.shape[-1]) for name, x in weights.items()}


def _is_widths(value: Any) -> bool:
    return isinstance(value, tuple) and all(map(checks.integer(1).accepts, value))


def map_log_std(function: Callable[[Array], Array], params: Any) -> Any:
    """The parameters of an `ActorCritic` with `std="shared"`, with another log standard deviation."""
    return params | {"params": params["params"] | {"log_std": function(params["params"]["log_std"])}}


def _flat(obs: Observation) -> tuple[Float[Array, "n own_dim"], dict[str, Entities]]:
    """All receivers in one leading axis; groups may have no slots."""
    num_receivers = math.prod(obs.own.shape[:-1])

    def merge(group: Entities) -> Entities:
        slots, dim = group.features.shape[-2:]
        return Entities(group.features.reshape(num_receivers, slots, dim), group.mask.reshape(num_receivers, slots))

    return obs.own.reshape(num_receivers, -1), {name: merge(group) for name, group in obs.groups.items()}
