"""Tasks with the interfaces of other libraries, which need not be installed."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxswarm.types import Key, Observation


@dataclasses.dataclass(frozen=True, eq=False)  # hashed by identity, for those who compile `step`
class Gymnax:
    """One world of a task as an environment of gymnax 1.0.

        env = Gymnax(jaxswarm.make("rendezvous"))
        obs, state = env.reset(key)
        obs, state, reward, terminated, truncated, info = env.step(key, state, action)

    Observations and actions are those of all agents, the reward is common to them. `params`, where they are given, are
    a task in place of the environment's own, as `env.default_params.replace(visibility_radius=0.3)`; numbers that fix
    no shape may be traced. A world that is over restarts within `step`; `info` then has what was to be seen before,
    `final_observation`, beside both flags and the metrics of the task. That a start state is drawn at every step is the
    price of this interface, which `jaxswarm.train` does not pay.
    """

    task: Any

    @property
    def name(self) -> str:
        """Of the task's class."""
        return type(self.task).__name__

    @property
    def default_params(self) -> Any:
        """The environment's own task."""
        return self.task

    @property
    def num_actions(self) -> int:
        """Numbers that an agent chooses at every step."""
        return self.task.action_dim

    def action_space(self, params: Any = None) -> Any:
        """A `Box` from -1 to 1, [agents, num_actions]; the one thing that takes gymnax to be installed."""
        from gymnax.environments import spaces  # noqa: PLC0415  # pyright: ignore[reportMissingImports]

        task = self.task if params is None else params
        return spaces.Box(-1.0, 1.0, (task.num_agents, task.action_dim))

    def reset(self, key: Key, params: Any = None) -> tuple[Observation, Any]:
        """What agents see of a fresh world, and its state."""
        task = self.task if params is None else params
        state = task.reset(key)
        return task.observe(state), state

    def step(
        self, key: Key, state: Any, action: Float[Array, "agents action_dim"], params: Any = None
    ) -> tuple[Observation, Any, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], dict[str, Any]]:
        """Observation, state, reward, terminated, truncated and info; actions are clipped to [-1, 1]."""
        task = self.task if params is None else params
        step_key, reset_key = jax.random.split(key)
        final_state, outcome = task.step(step_key, state, jnp.clip(action, -1.0, 1.0))
        is_done = outcome.terminated | outcome.truncated
        state = jax.tree.map(lambda a, b: jnp.where(is_done, a, b), task.reset(reset_key), final_state)
        flags = {"terminated": outcome.terminated, "truncated": outcome.truncated}
        info = outcome.metrics | flags | {"final_observation": task.observe(final_state)}
        return task.observe(state), state, outcome.reward, outcome.terminated, outcome.truncated, info
