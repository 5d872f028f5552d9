"""Steps per second of swarms of points with random actions, observations included; prints one JSON object per line.

    python benchmarks/environment_throughput.py [worlds=1,64] [agents=10,50] [tasks=pursuit] [repeats=3] [out=FILE]

`environment_steps_per_second` are steps of single worlds, `agent_steps_per_second` those times the agents. Each step is
followed by the observation of all agents, of which every number is used. Finished episodes restart from a few start
states. For pursuit, with one and with five evaders, `evasion_over_observation` is the time of the evaders' rule over
that of the observation of the same worlds. Boxes have a benchmark of their own, box_physics.py.
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
PAIRS_PER_RUN = 2e7  # bounds the time of one measurement


@partial(jax.jit, static_argnames=("num_envs", "num_steps"))
def play(task, key, num_envs, num_steps):
    """A number that depends on every step and observation."""
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
    states = jax.vmap(task.reset)(jax.random.split(key, num_envs))

    @jax.jit
    def flee(states):
        def rule(state):
            is_present = jnp.ones(task.num_agents, bool)
            flee = jax.vmap(evader_direction, (None, 0, None, None, None))
            return flee(task.space, state.evader_position, state.position, is_present, task.evader_visibility_radius)

        return jax.vmap(rule)(states)

    observe = jax.jit(jax.vmap(task.observe))
    rounds = [[seconds(f, states, repeats=1) for f in (flee, observe)] for _ in range(10 * repeats)]  # side by side
    times = [min(column) for column in zip(*rounds, strict=True)]
    return times[0] / times[1]


def measure(name, num_envs, num_agents, repeats):
    task_name, fields = TASK_FIELDS[name]
    task, key = TASKS[task_name](num_agents=num_agents, **fields), jax.random.key(0)
    num_steps = int(min(500, max(4, PAIRS_PER_RUN / num_envs / num_agents**2)))
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
    given = settings(overrides, tasks=",".join(TASK_FIELDS), worlds="1,64,1024,8192", agents="10,50,200", repeats="3")
    worlds, agents = ([int(number) for number in given[name].split(",")] for name in ("worlds", "agents"))
    for name, num_agents, num_envs in itertools.product(given["tasks"].split(","), agents, worlds):
        report(measure(name, num_envs, num_agents, int(given["repeats"])), given["out"])


if __name__ == "__main__":
    main(sys.argv[1:])
