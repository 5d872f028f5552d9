"""Five tiny tasks whose values and best actions are known; each needs one more part of a learner to work.

They are one task with different numbers, so that one compiled program trains all of them side by side.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp

from jaxswarm.types import Entities, Observation, Step, pytree, static


@pytree
class State:
    cue: jax.Array  # [agents], -1 or 1, the same for all
    time: jax.Array


@pytree
class Probe:
    """Two agents that see a common cue; the reward comes at the end of the episode.

    reward = constant + cue_reward cue - action_weight mean((action - target - cue_target cue)^2)
    """

    constant: float = 0.0
    cue_reward: float = 0.0
    action_weight: float = 0.0
    target: float = 0.0
    cue_target: float = 0.0
    length: int = 1
    num_agents: int = static(default=2)
    episode_length: int = static(default=2)  # the longest
    action_dim: ClassVar[int] = 1

    def reset(self, key):
        cue = jax.random.rademacher(key, (), jnp.float32)
        return State(jnp.full((self.num_agents,), cue), jnp.zeros((), jnp.int32))

    def step(self, key, state, action):
        del key
        time = state.time + 1
        error = jnp.square(action - self.target - self.cue_target * state.cue[:, None]).mean()
        is_done = time >= self.length
        reward = self.constant + self.cue_reward * state.cue.mean() - self.action_weight * error
        return State(state.cue, time), Step(jnp.where(is_done, reward, 0.0), is_done, jnp.zeros((), bool), {})

    def view(self, state):
        return jnp.stack([state.cue, jnp.broadcast_to(state.time, state.cue.shape).astype(jnp.float32)], -1)

    def perceive(self, view, agent):
        features = jnp.roll(view, -agent, axis=0)[1:]
        group = Entities(features, jnp.ones(features.shape[:1], bool))
        return Observation(view[agent], {"neighbors": group})

    def observe(self, state):
        return jax.vmap(self.perceive, (None, 0))(self.view(state), jnp.arange(self.num_agents))


PROBES = {
    "constant reward": Probe(constant=1.0),
    "reward that depends on the observation": Probe(cue_reward=1.0),
    "delayed reward": Probe(constant=1.0, length=2),
    "reward that depends on the action": Probe(action_weight=1.0, target=0.5),
    "reward that depends on both": Probe(action_weight=1.0, cue_target=0.5),
}
