"""Actor-critic network: an encoder per group, aggregators, a decoder, and the heads of actor and critic."""

import math
from collections.abc import Callable
from typing import Any, Literal, Protocol, runtime_checkable

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from jaxswarm import checks
from jaxswarm.aggregators import Mean, sets
from jaxswarm.aggregators.sets import EntityEncoder, RestrictsWidth, check_shape
from jaxswarm.checks import require
from jaxswarm.distributions import Policy, gaussian
from jaxswarm.limits import MAX_WIDTH
from jaxswarm.types import Entities, Observation


@runtime_checkable
class Network(Protocol):
    """Network that learners can train, such as `ActorCritic`.

    `apply(params, obs)` returns the policy and the value of every receiver, `apply(params, obs, method="value")` only
    the value. `std` is "shared" if the log standard deviation is the parameter `log_std`.
    """

    std: Literal["shared", "state"]
    apply: Callable[..., Any]


def leaky_relu(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return x where it is positive, else x / 100.

    As in PyTorch, the slope at 0 is 0.01 (with `jax.nn.leaky_relu` it is 1).
    """
    return jnp.where(x > 0, x, 0.01 * x)


ACTIVATIONS = {"leaky_relu": leaky_relu, "relu": nn.relu, "tanh": nn.tanh}
_HIDDEN_INIT = nn.initializers.orthogonal(math.sqrt(2.0))


class Encoder(nn.Module):
    """Dense layers, each followed by the activation, then an optional second stage.

    With `has_linear_output` the last layer has no activation. It computes each part of a message by a matrix product of
    its own; the kernels of all parts are initialized as one matrix.
    """

    widths: tuple[int, ...]
    activation: str
    num_parts: int = 1
    second_stage: Callable[..., tuple[Array, ...]] | None = None
    has_linear_output: bool = False

    @nn.compact
    def __call__(self, features: Float[Array, "n dim"]) -> tuple[Float[Array, "n width"], ...]:
        """Encode entities to the parts of their messages."""
        activation = ACTIVATIONS[self.activation]
        x = features
        for width in self.widths[:-1]:
            x = activation(nn.Dense(width, kernel_init=_HIDDEN_INIT)(x))
        size = self.num_parts * self.widths[-1]
        kernel = self.param("kernel", _HIDDEN_INIT, (x.shape[-1], size))
        bias = self.param("bias", nn.initializers.zeros, (size,))
        parts = zip(jnp.split(kernel, self.num_parts, 1), jnp.split(bias, self.num_parts), strict=True)
        outputs = tuple(x @ k + b[None] for k, b in parts)
        if not self.has_linear_output:
            outputs = tuple(map(activation, outputs))
        return outputs if self.second_stage is None else self.second_stage(*outputs)


class ParallelEncoders(nn.Module):
    """Encoders of the same entities, one per part of a message; without encoders, the features are the message."""

    encoders: tuple[EntityEncoder, ...]

    def __call__(self, features: Float[Array, "n dim"]) -> tuple[Float[Array, "n width"], ...]:
        """Return the parts in the order of the encoders."""
        return tuple(part for encoder in self.encoders for part in encoder(features)) if self.encoders else (features,)


class Tower(nn.Module):
    """Network from observations to latent vectors: encoders, aggregators and a decoder.

    The decoder gets [own, aggregate of each group in alphabetical order]. With `latent_space="shared"` each group has
    its own encoder, but all are aggregated together into one vector. See `ActorCritic` for the other fields.
    """

    encoder: tuple[int, ...]
    shared_encoder: tuple[int, ...]
    decoder: tuple[int, ...]
    activation: str
    aggregator: nn.Module
    latent_space: str
    linear_output_layers: bool

    def __call__(self, own: Float[Array, "n own_dim"], groups: dict[str, Entities]) -> Float[Array, "n latent"]:
        """Return the latent vector of each receiver."""
        return self._compute(own, groups)

    def weights(
        self, own: Float[Array, "n own_dim"], groups: dict[str, Entities]
    ) -> dict[str, Float[Array, "n slots"]]:
        """Return the share of each entity in the aggregate of its group."""
        return self._compute(own, groups, "weights")

    @nn.compact
    def _compute(self, own: Array, groups: dict[str, Entities], output: Literal["latent", "weights"] = "latent") -> Any:
        names = sorted(groups)
        self._check_latent_space(names)
        encoders = self._encoders(names)
        members = {"groups": names} if self.latent_space == "shared" else {name: [name] for name in names}
        x, weights = [own], {}
        for name, group_names in members.items():
            aggregator = self.aggregator.copy(name=f"{name}_aggregator")
            inputs = tuple(groups[group] for group in group_names)
            is_encoded = self.aggregator.num_encoders > 0
            width = (*self.encoder, *self.shared_encoder)[-1] if is_encoded else inputs[0].features.shape[-1]
            pool = sets.Pool(aggregator, tuple(encoders[group] for group in group_names), width)
            if output == "weights":
                weights |= dict(zip(group_names, pool.weights(inputs, own), strict=True))
            else:
                x.append(pool(inputs, own))
        if output == "weights":
            return weights
        latent = jnp.concatenate(x, -1)
        for i, width in enumerate(self.decoder, 1):
            latent = nn.Dense(width, kernel_init=_HIDDEN_INIT)(latent)
            if i < len(self.decoder) or not self.linear_output_layers:
                latent = ACTIVATIONS[self.activation](latent)
        return latent

    def _check_latent_space(self, names: list[str]) -> None:
        if self.latent_space == "shared" and self.aggregator.num_encoders == 0 and len(names) > 1:
            raise ValueError(
                f"latent_space: must be separate for the groups {', '.join(names)}, got 'shared'; "
                f"{type(self.aggregator).__name__} aggregates raw features, whose sizes differ between groups"
            )

    def _encoders(self, names: list[str]) -> dict[str, EntityEncoder]:
        """Return the encoder of each group.

        If each part of a message has its own encoder, the names of all but the first end with a number.
        """
        suffixes = ["", *(f"_{i}" for i in range(1, self.aggregator.num_encoders))][: self.aggregator.num_encoders]
        num_parts = self.aggregator.num_parts // max(len(suffixes), 1)

        def make(widths: tuple[int, ...], name: str, second_stage: Encoder | None = None) -> Encoder:
            first_parts = 1 if second_stage else num_parts
            has_linear_output = self.linear_output_layers and second_stage is None
            return Encoder(widths, self.activation, first_parts, second_stage, has_linear_output, name=name)

        shared = {s: make(self.shared_encoder, f"second_stage{s}") if self.shared_encoder else None for s in suffixes}
        return {
            name: ParallelEncoders(tuple(make(self.encoder, f"{name}_encoder{s}", shared[s]) for s in suffixes))
            for name in names
        }


class ActorCritic(nn.Module):
    """Actor and critic as two separate towers, shared by all agents.

    The message width is the last width before the aggregation, of `shared_encoder` or else of `encoder`.
    Initialization: orthogonal with gain sqrt(2) for the hidden layers, 0.01 for the action mean and for the head of the
    log standard deviation, and 1 for the value; the shared log standard deviation starts at 0.

    Attributes:
        encoder: Each group of entities has its own encoder with layers of these widths (at least one integer >= 1).
        decoder: The layers after the aggregation have these widths (integers >= 1; an empty list means no layers).
        shared_encoder: All groups share further layers of these widths between their own encoders and the aggregation
            (integers >= 1; an empty list means no layers).
        activation: The layers of encoders and decoder use this activation function: `leaky_relu`, `relu` or `tanh`.
        aggregator: This linen module aggregates the messages of a group into one vector (see `AGGREGATORS`).
        latent_space: Each group of entities is aggregated into its own vector (`separate`), or all groups together into
            one vector (`shared`).
        std: The log standard deviation of each action dimension is one parameter for all states (`shared`), or the
            output of a second head of the actor (`state`).
        linear_output_layers: The last layer before an aggregator and the last layer of the decoder have no activation
            if true; if false, all these layers have one, as in the thesis.
        action_dim: Actions have this many dimensions (an integer >= 1).
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

    __no_type_check__ = True  # `__post_init__` checks the fields, with a message for users

    def __post_init__(self) -> None:
        require(self, checks.Check("an aggregator, like Mean()", lambda x: isinstance(x, nn.Module)), "aggregator")
        widths = checks.Check(f"a tuple of integers from 1 to {MAX_WIDTH}", _are_widths)
        require(self, widths, "encoder", "shared_encoder", "decoder")
        require(self, checks.Check("a list of at least one layer, like [64]", lambda x: len(x) > 0), "encoder")
        require(self, checks.choice(ACTIVATIONS), "activation")
        require(self, checks.choice(("separate", "shared")), "latent_space")
        require(self, checks.choice(("shared", "state")), "std")
        require(self, checks.BOOL, "linear_output_layers")
        require(self, checks.integer(1), "action_dim")
        if isinstance(self.aggregator, RestrictsWidth):
            self.aggregator.check_width((*self.encoder, *self.shared_encoder)[-1])
        super().__post_init__()

    def setup(self) -> None:  # noqa: D102
        layers = (self.encoder, self.shared_encoder, self.decoder, self.activation)
        aggregation = (self.aggregator, self.latent_space, self.linear_output_layers)
        self.actor, self.critic = (Tower(*layers, *aggregation) for _ in range(2))
        self.action_mean = nn.Dense(self.action_dim, kernel_init=nn.initializers.orthogonal(0.01))
        self.value_head = nn.Dense(1, kernel_init=nn.initializers.orthogonal(1.0))
        if self.std == "state":
            self.action_log_std = nn.Dense(self.action_dim, kernel_init=nn.initializers.orthogonal(0.01))
        else:
            self.log_std = self.param("log_std", nn.initializers.zeros, (self.action_dim,))

    def __call__(self, obs: Observation) -> tuple[Policy, Float[Array, "*receivers"]]:
        """Return policy and value of every receiver.

        `obs` may have any leading axes. Raises a `ValueError` if the shapes of its arrays do not fit.
        """
        return self.policy(obs), self.value(obs)

    def policy(self, obs: Observation) -> Policy:
        """Return the action distribution of every receiver."""
        latent = self.actor(*_flatten_receivers(obs))
        mean = self.action_mean(latent).reshape(*obs.own.shape[:-1], self.action_dim)
        if self.std == "state":
            return gaussian(mean, self.action_log_std(latent).reshape(mean.shape))
        return gaussian(mean, self.log_std.reshape([1] * (mean.ndim - 1) + [-1]))

    def value(self, obs: Observation) -> Float[Array, "*receivers"]:
        """Return the value estimate of every receiver."""
        return self.value_head(self.critic(*_flatten_receivers(obs))).reshape(obs.own.shape[:-1])

    def weights(self, obs: Observation) -> dict[str, Float[Array, "*receivers slots"]]:
        """Return the share of each entity in the aggregates of the actor; see `weights` of the aggregator.

        The shares of present entities sum to 1 over each group, or over all groups with `latent_space="shared"`; absent
        entities have 0.
        """
        weights = self.actor.weights(*_flatten_receivers(obs))
        return {name: x.reshape(*obs.own.shape[:-1], x.shape[-1]) for name, x in weights.items()}


def _are_widths(value: Any) -> bool:
    return isinstance(value, tuple) and all(map(checks.size(1, MAX_WIDTH).accepts, value))


def map_log_std(function: Callable[[Array], Array], params: dict[str, Any]) -> dict[str, Any]:
    """Return the parameters of an `ActorCritic` with `std="shared"` and the function applied to `log_std`."""
    return params | {"params": params["params"] | {"log_std": function(params["params"]["log_std"])}}


def _flatten_receivers(obs: Observation) -> tuple[Float[Array, "n own_dim"], dict[str, Entities]]:
    """Merge all leading axes into one; groups may have no slots."""
    _check_observation(obs)
    num_receivers = math.prod(obs.own.shape[:-1])

    def merge(group: Entities) -> Entities:
        slots, dim = group.features.shape[-2:]
        return Entities(group.features.reshape(num_receivers, slots, dim), group.mask.reshape(num_receivers, slots))

    return obs.own.reshape(num_receivers, -1), {name: merge(group) for name, group in obs.groups.items()}


def _check_observation(obs: Observation) -> None:
    receivers = obs.own.shape[:-1]
    check_shape("obs.own", obs.own, *receivers, None)
    for name, group in obs.groups.items():
        check_shape(f"obs.groups[{name!r}].features", group.features, *receivers, None, None)
        check_shape(f"obs.groups[{name!r}].mask", group.mask, *group.features.shape[:-1])
    if obs.mask is not None:
        check_shape("obs.mask", obs.mask, *receivers)
