"""Adapter that gives a task the interface of gymnax 1.0. Only `action_space` requires gymnax to be installed."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxswarm.types import Key, Observation, clip_action


@dataclasses.dataclass(frozen=True, eq=False)  # hashed by identity, so `env.step` can be jitted
class Gymnax:
    """Environment with the interface of gymnax 1.0 for one instance of a task.

        env = Gymnax(jaxswarm.make("rendezvous"))
        obs, state = env.reset(key)
        obs, state, reward, terminated, truncated, info = env.step(key, state, action)

    Observations and actions are those of all agents, and all agents share the reward. All methods are pure functions;
    use `jax.vmap` for several environments.

    The argument `params` is a task that replaces the environment's own, such as
    `env.default_params.replace(visibility_radius=0.3)`. Its numeric fields that determine no shape may be traced.

    `step` samples a start state at every step, because it resets within `step`. `jaxswarm.train` avoids this cost.
    """

    task: Any  # frozen pytree of `jaxswarm.TASKS`

    @property
    def name(self) -> str:
        """Name of the task's class."""
        return type(self.task).__name__

    @property
    def default_params(self) -> Any:
        """Task of this environment, the default of `params`."""
        return self.task

    @property
    def num_actions(self) -> int:
        """Size of the action of one agent, `action_dim`."""
        return self.task.action_dim

    def action_space(self, params: Any = None) -> Any:
        """Return the gymnax space `Box(-1, 1)` of shape [agents, action_dim]. Requires gymnax."""
        from gymnax.environments import spaces  # noqa: PLC0415  # pyright: ignore[reportMissingImports]

        task = self.task if params is None else params
        return spaces.Box(-1.0, 1.0, (task.num_agents, task.action_dim))

    def reset(self, key: Key, params: Any = None) -> tuple[Observation, Any]:
        """Sample a start state; return the observation and the state.

        The observation has `own` [agents, own_dim] and `groups`, a dict from group names to `features`
        [agents, slots, dim] and `mask` [agents, slots] (True where a slot holds an entity).
        """
        task = self.task if params is None else params
        state = task.reset(key)
        return task.observe(state), state

    def step(
        self, key: Key, state: Any, action: Float[Array, "agents action_dim"], params: Any = None
    ) -> tuple[Observation, Any, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], dict[str, Any]]:
        """Take a step; return (observation, state, reward, terminated, truncated, info).

        `action` is [agents, action_dim] and is clipped to [-1, 1]. `reward` is a scalar float; `terminated` and
        `truncated` are scalar bools. If either is true, the returned observation and state are those of a new episode.

        `info` is a dict with the scalar metrics of the task, `terminated`, `truncated`, and `final_observation`. This
        is the observation after the step and before a reset. Use it for the bootstrap value at truncation.
        """
        task = self.task if params is None else params
        step_key, reset_key = jax.random.split(key)
        final_state, outcome = task.step(step_key, state, clip_action(action))
        is_done = outcome.terminated | outcome.truncated
        state = jax.tree.map(lambda a, b: jnp.where(is_done, a, b), task.reset(reset_key), final_state)
        flags = {"terminated": outcome.terminated, "truncated": outcome.truncated}
        info = outcome.metrics | flags | {"final_observation": task.observe(final_state)}
        return task.observe(state), state, outcome.reward, outcome.terminated, outcome.truncated, info
