"""Trained policies as programs that need no more than JAX (`jax.export`: StableHLO, with the parameters inside)."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jaxtyping import Array, Bool, Float

from jaxswarm.types import Entities, Observation

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")

Group = tuple[Float[Array, "slots dim"], Bool[Array, " slots"]]  # features and mask of one agent


def export_policy(task: Any, network: Any, params: Any) -> export.Exported:
    """The policy as a program from observations to means and standard deviations of actions, [agents, action_dim].

        file.write_bytes(export_policy(task, network, params).serialize())
        mean, std = jax.export.deserialize(file.read_bytes()).call(own, groups)

    `own` is [agents, own_dim], `groups` has (features [agents, slots, dim], mask [agents, slots]) by name, as `observe`
    gives them: for any number of agents, be it all of a swarm or one robot, and as many slots as agents of this `task`
    have. Slots that are not needed are masked, so a task of many agents gives a program for any smaller swarm.
    Evaluations act by the mean; the worlds clip it to [-1, 1].
    """
    (agents,) = export.symbolic_shape("agents")
    obs = jax.eval_shape(lambda key: task.observe(task.reset(key)), jax.random.key(0))

    def of_any_number(leaf: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((agents, *leaf.shape[1:]), leaf.dtype)

    groups = {name: (group.features, group.mask) for name, group in obs.groups.items()}
    inputs = jax.tree.map(of_any_number, (obs.own, groups))

    @jax.jit
    @jax.vmap
    def act(own: Float[Array, " own_dim"], groups: dict[str, Group]) -> tuple[Array, Array]:
        of_one = Observation(own, {name: Entities(*group) for name, group in groups.items()})
        distribution = network.apply(params, of_one, method="policy")
        mean = distribution.mean()
        return mean, jnp.broadcast_to(distribution.stddev(), mean.shape)

    return export.export(act, platforms=PLATFORMS)(*inputs)
