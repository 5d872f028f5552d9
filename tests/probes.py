"""Five tiny tasks with known values and best actions; each of them needs one more part of a learner.

They are one task with different numbers, so that one compiled program trains all of them vectorized. For the same
reason, TRL selects its projection by a number here.
"""

from functools import cache
from typing import ClassVar

import jax
import jax.numpy as jnp
import pytest

import jaxswarm
from jaxswarm import AGGREGATORS, LEARNERS, ActorCritic, Experiment
from jaxswarm.learners.projections import PROJECTIONS, Projection
from jaxswarm.learners.trl import TRL
from jaxswarm.types import Entities, Observation, Step, pytree, static


@pytree
class State:
    cue: jax.Array  # [agents], -1 or 1, equal for all agents
    time: jax.Array


@pytree
class Probe:
    """Task of two agents that observe a common cue; the reward comes at the end of the episode.

    reward = constant + cue_reward cue - action_weight mean((action - target - cue_target cue)^2)
    """

    constant: float = 0.0
    cue_reward: float = 0.0
    action_weight: float = 0.0
    target: float = 0.0
    cue_target: float = 0.0
    length: int = 1
    num_agents: int = static(default=2)
    episode_length: int = static(default=2)  # the maximum of `length`
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

OPTIONS = {"num_epochs": 8, "batch_size": 64, "learning_rate": 3e-3, "discount": 0.5}
SIZES = {"num_envs": 64, "num_steps": 2, "num_eval_envs": 8, "eval_every": 20}
NUM_UPDATES = 40
NETWORK = ActorCritic(encoder=(8,), decoder=(16,), aggregator=AGGREGATORS["mean"](), action_dim=1)
CASES = [
    pytest.param((name, projection), marks=pytest.mark.slow if projection else (), id=f"{name}-{projection}")
    for name in LEARNERS
    for projection in (PROJECTIONS if name == "trl" else [None])
]


@pytree
class IndexedTRL(TRL):
    """TRL whose projection is selected by a number."""

    index: int = 0

    @property
    def layer(self):
        def function(name):
            branches = [getattr(projection, name) for projection in PROJECTIONS.values()]
            return lambda *args: jax.lax.switch(self.index, branches, *args)

        return Projection(*map(function, ("mean_part", "cov_part", "project_std")))


@cache
def _train_all(name):
    """Train all probes, TRL with all projections; returns the results of `train_probes`, [projections, probes, ...]."""
    learner = IndexedTRL(**OPTIONS) if name == "trl" else LEARNERS[name](**OPTIONS)

    def train(index, task):
        chosen = learner.replace(index=index) if name == "trl" else learner
        experiment = Experiment(task, NETWORK, chosen, **SIZES)
        state = jaxswarm.init(experiment, jax.random.key(0))

        def update(state, _):
            state, metrics = jaxswarm.train(experiment, state, 1)
            return state, (state.learner.params, metrics["eval/return"][0])

        params, returns = jax.lax.scan(update, state, length=NUM_UPDATES)[1]
        return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), state.learner.params, params), returns

    indices = jnp.arange(len(PROJECTIONS) if name == "trl" else 1)
    tasks = jax.tree.map(lambda *x: jnp.array(x), *PROBES.values())
    return jax.jit(jax.vmap(jax.vmap(train, (None, 0)), (0, None)))(indices, tasks)


def train_probes(name, projection):
    """Return, per probe, the parameters before the first and after each update, and the returns before each."""
    index = list(PROJECTIONS).index(projection) if projection else 0
    results = _train_all(name)
    return {probe: jax.tree.map(lambda x, i=i: x[index, i], results) for i, probe in enumerate(PROBES)}


def policy_and_value(params, cue, time):
    """Return policy and value of the first agent."""
    obs = next(iter(PROBES.values())).observe(State(jnp.full((2,), cue, jnp.float32), jnp.int32(time)))
    policy, value = NETWORK.apply(params, obs)
    return policy[0], value[0]
