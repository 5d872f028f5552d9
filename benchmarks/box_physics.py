"""Measure environment steps per second of the tasks with boxes, and of Box2D from Python on the same scenes.

    python benchmarks/box_physics.py [num_envs=1,64,1024] [seconds=2] [physics=faithful] [out=FILE]

The benchmark prints one JSON object per line. It uses one core and measures the CPU time of this process, so other
processes have little influence. Rows of kind `physics` take steps of 1 s with random commands. Rows of kind
`environment` also compute observations and the reward.

Box2D simulates one environment at a time. As in the thesis's program, Python sets the velocities of all robots before
each of ten steps of 0.1 s. NumPy computes the observations and the reward. The benchmark needs the extra `benchmarks`.
"""

import importlib.metadata
import itertools
import math
import os
import sys
import time

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
if hasattr(os, "sched_setaffinity"):  # Linux; other systems may use several cores
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import jax
import numpy as np
from timing import report, settings

from jaxswarm.physics.contacts import MAX_SPEED, MAX_TURN_RATE
from jaxswarm.tasks.boxes import Assembly

SCENES = ((10, 4, 1.0), (20, 12, 2.0))
UNITS = 25  # Box2D's units per meter
HOLD = 5  # steps for which robots keep their commands


class Box2DWorld:
    """The environment of the thesis in Box2D; the start poses are rows of x, y (m) and heading (rad)."""

    def __init__(self, side: float, robots: np.ndarray, boxes: np.ndarray):
        import Box2D  # noqa: PLC0415 - so that --help works without it

        self.box2d = Box2D
        self.world = Box2D.b2World(gravity=(0, 0), doSleep=True)
        half = side * UNITS / 2
        walls = Box2D.b2ChainShape(vertices_loop=[(-half, -half), (half, -half), (half, half), (-half, half)])
        self.world.CreateStaticBody(fixtures=Box2D.b2FixtureDef(shape=walls, friction=0.2))
        square = Box2D.b2PolygonShape(box=(0.05 * UNITS, 0.05 * UNITS))
        disc = Box2D.b2CircleShape(radius=0.0165 * UNITS)
        self.boxes = [self._body(pose, square, 0.01) for pose in boxes]
        self.robots = [self._body(pose, disc, 0.0) for pose in robots]

    def _body(self, pose, shape, friction):
        x, y, angle = map(float, pose)
        fixture = self.box2d.b2FixtureDef(shape=shape, density=2, friction=friction, restitution=0)
        place = (x * UNITS, y * UNITS)
        return self.world.CreateDynamicBody(
            position=place, angle=angle, linearDamping=0.8, angularDamping=0.8, fixtures=fixture
        )

    def step(self, commands: list) -> None:
        """Advance by 1 s with one command (m/s, rad/s) per robot."""
        for _ in range(10):
            for robot, (speed, turn_rate) in zip(self.robots, commands, strict=True):
                angle = robot.angle
                robot.linearVelocity = (UNITS * speed * math.cos(angle), UNITS * speed * math.sin(angle))
                robot.angularVelocity = turn_rate
            self.world.Step(0.1, 10, 10)
            self.world.ClearForces()

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses of robots and of boxes, rows of x, y (m) and heading (rad)."""
        return tuple(
            np.array([(*body.position, body.angle) for body in bodies]) / (UNITS, UNITS, 1)
            for bodies in (self.robots, self.boxes)
        )


def numpy_observation(robots: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return the observations of all robots, flat and in the order of the thesis's program."""

    def seen(others: np.ndarray) -> list[np.ndarray]:
        delta = others[None, :, :2] - robots[:, None, :2]
        bearing = np.arctan2(delta[..., 1], delta[..., 0]) - robots[:, None, 2]
        turn = others[None, :, 2] - robots[:, None, 2]
        return [np.linalg.norm(delta, axis=-1), np.sin(bearing), np.cos(bearing), np.sin(turn), np.cos(turn)]

    count = len(robots)
    neighbors = np.stack(seen(robots), -1)[~np.eye(count, dtype=bool)].reshape(count, -1)
    places = [np.broadcast_to(boxes[:, i], (count, len(boxes))) for i in (0, 1)]
    own = np.stack([robots[:, 0], robots[:, 1], np.sin(robots[:, 2]), np.cos(robots[:, 2]), np.ones(count)], -1)
    return np.concatenate([neighbors, np.stack([*seen(boxes), *places], -1).reshape(count, -1), own], -1)


def box_distances(boxes: np.ndarray) -> float:
    """Return the sum of the distances of all pairs of boxes in m."""
    return sum(math.dist(a[:2], b[:2]) for a, b in itertools.combinations(boxes, 2))


def box2d_rate(task: Assembly, is_environment: bool, seconds: float) -> float:
    """Return the environment steps of Box2D per second of CPU time."""
    generator = np.random.default_rng(0)
    state = task.reset(jax.random.key(0))
    robots = np.concatenate([state.position, state.heading[:, None]], -1)
    boxes = np.concatenate([state.box_position, state.box_heading[:, None]], -1)
    world, total_distance, steps = Box2DWorld(task.side, robots, boxes), box_distances(boxes), 0
    start = time.process_time()
    while time.process_time() - start < seconds:
        speed = MAX_SPEED * generator.random(task.num_agents)
        turn_rate = MAX_TURN_RATE * generator.uniform(-1, 1, task.num_agents)
        commands = list(zip(speed.tolist(), turn_rate.tolist(), strict=True))
        for _ in range(HOLD):
            world.step(commands)
            if is_environment:
                poses = world.poses()
                numpy_observation(*poses)
                next_distance = box_distances(poses[1])
                _reward = total_distance - next_distance
                total_distance = next_distance
            steps += 1
    return steps / (time.process_time() - start)


def jaxswarm_rate(task: Assembly, num_envs: int, is_environment: bool, seconds: float) -> tuple[float, float]:
    """Return the environment steps of jaxswarm per second of CPU time, and the seconds of tracing and compiling."""

    @jax.jit
    def advance(states, key):
        action = jax.random.uniform(key, (num_envs, task.num_agents, 2), minval=-1)

        def step(states, _):
            if not is_environment:
                return jax.vmap(task.arena.move)(states, action), None
            states, outcome = jax.vmap(task.step, (None, 0, 0))(key, states, action)
            return states, (jax.vmap(task.observe)(states), outcome.reward)

        return jax.lax.scan(step, states, length=HOLD)

    states = jax.jit(jax.vmap(task.reset))(jax.random.split(jax.random.key(0), num_envs))
    compile_start = time.perf_counter()
    program = advance.lower(states, jax.random.key(1)).compile()
    compile_seconds = time.perf_counter() - compile_start
    states, _ = jax.block_until_ready(program(states, jax.random.key(1)))
    steps, start = 0, time.process_time()
    while time.process_time() - start < seconds:
        states, _ = jax.block_until_ready(program(states, jax.random.key(steps)))
        steps += HOLD * num_envs
    return steps / (time.process_time() - start), compile_seconds


def main(overrides: list[str]) -> None:
    given = settings(overrides, num_envs="1,64,1024", seconds="2", physics="faithful")
    seconds = float(given["seconds"])
    for (num_agents, num_boxes, side), kind in itertools.product(SCENES, ("physics", "environment")):
        task = Assembly(num_agents=num_agents, num_boxes=num_boxes, side=side, physics=given["physics"])
        is_environment = kind == "environment"
        box2d = box2d_rate(task, is_environment, seconds)
        for num_envs in map(int, given["num_envs"].split(",")):
            rate, compile_seconds = jaxswarm_rate(task, num_envs, is_environment, seconds)
            row = {
                "benchmark": "box_physics",
                "kind": kind,
                "robots": num_agents,
                "boxes": num_boxes,
                "physics": given["physics"],
                "num_envs": num_envs,
                "steps_per_cpu_second": rate,
                "box2d_steps_per_cpu_second": box2d,
                "ratio": rate / box2d,
                "compile_seconds": compile_seconds,
                "box2d_version": importlib.metadata.version("Box2D"),
            }
            report(row, given["out"])


if __name__ == "__main__":
    main(sys.argv[1:])
