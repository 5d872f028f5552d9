"""Measure steps per second of the tasks without boxes, with random actions and including observations.

    python benchmarks/environment_throughput.py [tasks=pursuit] [num_envs=1,64] [num_agents=10] [repeats=3] [out=FILE]

The benchmark prints one JSON object per line, for each combination of task, `num_agents` and `num_envs`.
`environment_steps_per_second` counts the steps of single environments. `agent_steps_per_second` multiplies this by the
number of agents. After each step, all agents observe, and every number of the observations is used. Finished episodes
restart from a few start states.

For pursuit of one evader and of five evaders, `evasion_over_observation` is a ratio of times: the evaders' rule over
the observation of the same environments. The tasks with boxes have their own benchmark, box_physics.py.
"""

import itertools
import sys
from functools import partial

import jax
import jax.numpy as jnp
from timing import report, seconds, settings

from jaxswarm import TASKS
from jaxswarm.tasks.evasion import evader_direction

TASK_FIELDS = {
    "rendezvous": ("rendezvous", {}),
    "pursuit": ("pursuit", {}),
    "pursuit_multi": ("pursuit", {"num_evaders": 5, "reward": "catches"}),
}
PAIRS_PER_MEASUREMENT = 2e7  # pairs of agents; bounds the time of one measurement


@partial(jax.jit, static_argnames=("num_envs", "num_steps"))
def play(task, key, num_envs, num_steps):
    """Return the sum of all rewards and observations, so that XLA can drop no step and no observation."""
    start = jax.vmap(task.reset)(jax.random.split(key, num_envs))

    def step(carry, key):
        state, total = carry
        action_key, step_key = jax.random.split(key)
        action = jax.random.uniform(action_key, (num_envs, task.num_agents, task.action_dim), minval=-1)
        state, outcome = jax.vmap(task.step)(jax.random.split(step_key, num_envs), state, action)
        obs = jax.vmap(task.observe)(state)
        total += sum(leaf.sum() for leaf in jax.tree.leaves((obs.own, obs.groups, outcome.reward)))
        is_done = outcome.terminated | outcome.truncated
        state = jax.vmap(lambda done, a, b: jax.tree.map(partial(jnp.where, done), a, b))(is_done, start, state)
        return (state, total), None

    (_, total), _ = jax.lax.scan(step, (start, jnp.zeros(())), jax.random.split(key, num_steps))
    return total


def evasion_over_observation(task, key, num_envs, repeats):
    """Return the time of the evaders' rule over the time of the observation, both in `num_envs` environments."""
    states = jax.vmap(task.reset)(jax.random.split(key, num_envs))

    @jax.jit
    def flee(states):
        def rule(state):
            is_present = jnp.ones(task.num_agents, bool)
            flee = jax.vmap(evader_direction, (None, 0, None, None, None))
            return flee(task.space, state.evader_position, state.position, is_present, task.evader_visibility_radius)

        return jax.vmap(rule)(states)

    observe = jax.jit(jax.vmap(task.observe))
    rounds = [[seconds(f, states, repeats=1) for f in (flee, observe)] for _ in range(10 * repeats)]  # in turn
    times = [min(column) for column in zip(*rounds, strict=True)]
    return times[0] / times[1]


def measure(name, num_envs, num_agents, repeats):
    """Return the row of one task at one size."""
    task_name, fields = TASK_FIELDS[name]
    task, key = TASKS[task_name](num_agents=num_agents, **fields), jax.random.key(0)
    num_steps = int(min(500, max(4, PAIRS_PER_MEASUREMENT / num_envs / num_agents**2)))
    duration = seconds(partial(play, task, key, num_envs, num_steps), repeats=repeats)
    rate = num_envs * num_steps / duration
    result = {
        "task": name,
        "num_envs": num_envs,
        "num_agents": num_agents,
        "environment_steps_per_second": rate,
        "agent_steps_per_second": rate * num_agents,
    }
    if task_name == "pursuit":
        result["evasion_over_observation"] = evasion_over_observation(task, key, num_envs, repeats)
    return result


def main(overrides):
    defaults = {"num_envs": "1,64,1024,8192", "num_agents": "10,50,200", "repeats": "3"}
    given = settings(overrides, tasks=",".join(TASK_FIELDS), **defaults)
    envs, agents = ([int(number) for number in given[name].split(",")] for name in ("num_envs", "num_agents"))
    for name, num_agents, num_envs in itertools.product(given["tasks"].split(","), agents, envs):
        report(measure(name, num_envs, num_agents, int(given["repeats"])), given["out"])


if __name__ == "__main__":
    main(sys.argv[1:])
