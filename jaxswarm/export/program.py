"""Export of trained policies to programs that only need JAX (`jax.export`: StableHLO that contains the parameters)."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jaxtyping import Array, Bool, Float

from jaxswarm.types import Entities, Observation

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")

Group = tuple[Float[Array, "slots dim"], Bool[Array, " slots"]]  # features and mask of one agent


def export_policy(task: Any, network: Any, params: Any) -> export.Exported:
    """Return the policy as a program from observations to means and standard deviations of the actions.

        file.write_bytes(export_policy(task, network, params).serialize())
        mean, std = jax.export.deserialize(file.read_bytes()).call(own, groups)

    Shapes: `mean` and `std` [agents, action_dim]; `own` [agents, own_dim]; `groups` maps each group name to
    (features [agents, slots, dim], mask [agents, slots]), as `task.observe` returns them.

    The number of agents is free: a whole swarm or a single robot. The number of slots is that of `task`. Unneeded slots
    are masked, so a task with many agents gives a program for any smaller swarm. The program runs on `PLATFORMS`.
    Evaluations use the mean as the action, and tasks clip it to [-1, 1].
    """
    (agents,) = export.symbolic_shape("agents")
    obs = jax.eval_shape(lambda key: task.observe(task.reset(key)), jax.random.key(0))

    def with_any_agents(leaf: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((agents, *leaf.shape[1:]), leaf.dtype)

    groups = {name: (group.features, group.mask) for name, group in obs.groups.items()}
    inputs = jax.tree.map(with_any_agents, (obs.own, groups))

    @jax.jit
    @jax.vmap
    def act(own: Float[Array, " own_dim"], groups: dict[str, Group]) -> tuple[Array, Array]:
        agent_obs = Observation(own, {name: Entities(*group) for name, group in groups.items()})
        distribution = network.apply(params, agent_obs, method="policy")
        mean = distribution.mean()
        return mean, jnp.broadcast_to(distribution.stddev(), mean.shape)

    return export.export(act, platforms=PLATFORMS)(*inputs)
