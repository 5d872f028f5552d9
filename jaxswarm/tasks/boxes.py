"""Robots that push boxes: together (assembly), or apart by colour (clustering).

One world with different rewards. A robot is a disc, and a box a square, of `rigid2d`; the square world has its centre
at the origin, with x and y in [-side/2, side/2].
"""

import dataclasses
import math
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxswarm import rigid2d
from jaxswarm.contacts import BOX_SIDE, DISC_RADIUS, MAX_SPEED, MAX_TURN_RATE
from jaxswarm.geometry import bearing, direction, norm, unit
from jaxswarm.scene import Bodies, Goals, Scene
from jaxswarm.tasks.swarm import NumberRange, after, draw_number, require_range
from jaxswarm.types import Entities, Key, Metrics, Observation, Step, is_whole, pytree, require, static

CORNERS = ((-0.5, -0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, 0.5))  # over the side; where clusters belong, in their order
MARGIN = 0.02  # m, that robots keep off the walls at first
CENTRAL = 0.7  # share of the side where boxes may be at first
SETTLING = 6  # substeps before an episode; these leave such overlaps as the one step of Box2D in the thesis's program


@pytree
class State:
    """One world."""

    position: Float[Array, "agents 2"]  # m
    heading: Float[Array, "agents"]  # rad, counter-clockwise from x
    box_position: Float[Array, "boxes 2"]  # m
    box_heading: Float[Array, "boxes"]  # rad
    box_velocity: Float[Array, "boxes 3"]  # x and y in m / s, turn rate in rad / s
    box_present: Bool[Array, "boxes"]  # absent boxes are neither seen, touched nor rewarded
    time: Int[Array, ""]  # steps since reset


@pytree
class View:
    """What is known of each robot and each box by itself, so that pairs need no trigonometry."""

    position: Float[Array, "agents 2"]
    direction: Float[Array, "agents 2"]  # [cos, sin] of the heading
    own: Float[Array, "agents 5"]
    box_position: Float[Array, "boxes 2"]
    box_direction: Float[Array, "boxes 2"]
    box_present: Bool[Array, "boxes"]


@pytree
class Arena:
    """The world of both tasks: how it starts, how it moves, and what robots perceive of it."""

    side: float
    num_agents: int = static()
    cluster: tuple[int, ...] = static()  # of each box
    active_boxes: NumberRange | None = static()
    physics: str = static()

    @property
    def num_boxes(self) -> int:
        """Those that may be present."""
        return len(self.cluster)

    def reset(self, key: Key) -> State:
        """Robots anywhere, boxes in the middle, looking anywhere; overlaps are then mostly pushed apart."""
        position_key, heading_key, box_position_key, box_heading_key, number_key = jax.random.split(key, 5)

        def uniform(key: Key, bound: float | Array, *shape: int) -> Array:
            return bound * jax.random.uniform(key, shape, minval=-1.0)

        position = uniform(position_key, self.side / 2, self.num_agents, 2)
        limit = self.side / 2 - MARGIN
        number = draw_number(number_key, self.active_boxes, self.num_boxes)
        state = State(
            position=jnp.clip(position, -limit, limit),
            heading=uniform(heading_key, math.pi, self.num_agents),
            box_position=uniform(box_position_key, CENTRAL * self.side / 2, self.num_boxes, 2),
            box_heading=uniform(box_heading_key, math.pi, self.num_boxes),
            box_velocity=jnp.zeros((self.num_boxes, 3)),
            box_present=jnp.asarray(self.turn_taking()) < number,
            time=jnp.zeros((), jnp.int32),
        )
        return rigid2d.settle(rigid2d.PRESETS[self.physics], self.side, state, SETTLING)

    def turn_taking(self) -> np.ndarray:
        """The order in which boxes come in, `[boxes]`: the first of each cluster, then the second of each, ..."""
        cluster = np.array(self.cluster)
        rank = np.array([(cluster[:box] == cluster[box]).sum() for box in range(self.num_boxes)])
        return np.argsort(np.lexsort((cluster, rank)))

    def move(self, state: State, action: Float[Array, "agents 2"]) -> State:
        """One second later, with actions clipped to [-1, 1]: v = 0.005 (a_0 + 1) m / s, w = pi / 2 a_1 rad / s."""
        action = jnp.clip(action, -1, 1)
        speed, turn_rate = MAX_SPEED / 2 * (action[:, 0] + 1), MAX_TURN_RATE * action[:, 1]
        command = jnp.stack([speed, turn_rate], -1)
        state = rigid2d.move(rigid2d.PRESETS[self.physics], self.side, state, command)
        return dataclasses.replace(state, time=state.time + 1)

    def view(self, state: State) -> View:
        """What `perceive` needs of a state."""
        ahead = direction(state.heading)
        fraction = jnp.full((self.num_agents, 1), state.box_present.mean())
        return View(
            position=state.position,
            direction=ahead,
            own=jnp.concatenate([state.position, ahead[:, ::-1], fraction], -1),
            box_position=state.box_position,
            box_direction=direction(state.box_heading),
            box_present=state.box_present,
        )

    def perceive(self, view: View, agent: Int[Array, ""]) -> Observation:
        """What one robot perceives; groups are `neighbors`, in cyclic order from the robot after it on, and `boxes`.

        Own features: x, y, [sin, cos] of the heading, fraction of the boxes that is present. Of neighbours and boxes:
        distance, [sin, cos] of the counter-clockwise bearing to them, and of their heading less one's own; of boxes
        also x, y. All in metres.
        """

        def window(leaf: Array, start: Array, size: int) -> Array:
            return jax.lax.dynamic_slice_in_dim(jnp.concatenate([leaf, leaf]), start, size)

        def seen(position: Array, heading: Array) -> Array:
            displacement = position - my_position
            distance = norm(displacement)
            toward = unit(displacement, distance)
            return jnp.concatenate([distance[:, None], _turn(ahead, toward), _turn(ahead, heading)], -1)

        my_position, ahead = window(view.position, agent, 1), window(view.direction, agent, 1)
        num_others = self.num_agents - 1
        others = seen(window(view.position, agent + 1, num_others), window(view.direction, agent + 1, num_others))
        boxes = jnp.concatenate([seen(view.box_position, view.box_direction), view.box_position], -1)
        present = view.box_present
        groups = {
            "neighbors": Entities(features=others, mask=jnp.ones(num_others, bool)),
            "boxes": Entities(features=jnp.where(present[:, None], boxes, 0), mask=present),
        }
        return Observation(own=window(view.own, agent, 1)[0], groups=groups)

    def slots(self) -> dict[str, Int[Array, "agents slots"]]:
        """Which body of the scene is in which slot of `perceive`, for all robots."""
        robots = jnp.arange(self.num_agents)
        boxes = jnp.broadcast_to(self.num_agents + jnp.arange(self.num_boxes), (self.num_agents, self.num_boxes))
        return {"neighbors": jax.vmap(after, (0, None))(robots, self.num_agents), "boxes": boxes}

    def scene(self, state: State) -> Scene:
        """Discs and squares between walls; boxes are grouped by cluster."""
        robots = Bodies(state.position, jnp.ones(self.num_agents, bool), state.heading, size=DISC_RADIUS)
        cluster = jnp.array(self.cluster)
        boxes = Bodies(state.box_position, state.box_present, state.box_heading, cluster, size=BOX_SIDE)
        corner = jnp.full(2, self.side / 2)
        return Scene(-corner, corner, False, robots, boxes=boxes)


def _turn(ahead: Float[Array, "*#n 2"], toward: Float[Array, "*#n 2"]) -> Float[Array, "*n 2"]:
    """[sin, cos] of the counter-clockwise angle from `ahead` to `toward`."""
    return bearing(ahead, toward)[:, ::-1] * jnp.array([[-1.0, 1.0]])


def _pairs(position: Float[Array, "n 2"]) -> Float[Array, "n n"]:
    """Distances between all."""
    return norm(position[:, None] - position[None])


def _mean(values: Float[Array, "*#n"], is_counted: Bool[Array, "*#n"], axis: int | tuple | None = None) -> Array:
    """Of those that count; 0 if none does."""
    return jnp.where(is_counted, values, 0).sum(axis) / jnp.maximum(is_counted.sum(axis), 1)


def _now_and_finally(is_over: Bool[Array, ""], metrics: Metrics) -> Metrics:
    """Metrics at every step, and once more at the last."""
    return metrics | {f"final_{name}": jnp.where(is_over, value, jnp.nan) for name, value in metrics.items()}


def _check(task: "Assembly | Clustering") -> None:
    require(task, "whole numbers from 1", is_whole(1), "num_agents", "num_boxes", "episode_length")
    at_least = f"sides of a square that a box fits in, from {2 * BOX_SIDE}"
    require(task, at_least, lambda x: 2 * BOX_SIDE <= x < math.inf, "side")
    require(task, ", ".join(rigid2d.PRESETS), lambda x: x in rigid2d.PRESETS, "physics")
    require_range(task, "active_boxes", 1, task.num_boxes)


@pytree
class Assembly:
    """Robots are to push all boxes together (section 5.2.4 of the thesis, whose figures used the defaults)."""

    num_agents: int = static(default=10)
    num_boxes: int = static(default=4)
    side: float = 1.0
    episode_length: int = static(default=512)
    physics: str = static(default="faithful")
    active_boxes: NumberRange | None = static(default=None)

    action_dim: ClassVar[int] = 2

    def __post_init__(self) -> None:
        _check(self)

    @property
    def arena(self) -> Arena:
        """The world that robots and boxes are in."""
        return Arena(self.side, self.num_agents, (0,) * self.num_boxes, self.active_boxes, self.physics)

    def reset(self, key: Key) -> State:
        """See `Arena.reset`."""
        return self.arena.reset(key)

    def step(self, key: Key, state: State, action: Float[Array, "agents 2"]) -> tuple[State, Step]:
        """One step of 1 s; nothing in it is random.

            reward = sum_{i<j} (d_ij before - d_ij after)

        of the distances in metres between the centres of boxes.
        """
        after = self.arena.move(state, action)
        before_distance, after_distance = _pairs(state.box_position), _pairs(after.box_position)
        is_pair = state.box_present[:, None] & state.box_present[None] & ~jnp.eye(self.num_boxes, dtype=bool)
        is_over = after.time >= self.episode_length
        step = Step(
            reward=jnp.where(is_pair, before_distance - after_distance, 0).sum() / 2,
            terminated=jnp.array(False),
            truncated=is_over,
            metrics=_now_and_finally(is_over, {"box_distance": _mean(after_distance, is_pair)}),
        )
        return after, step

    def view(self, state: State) -> View:
        """What `perceive` needs of a state, in O(agents + boxes) memory."""
        return self.arena.view(state)

    def perceive(self, view: View, agent: Int[Array, ""]) -> Observation:
        """What one robot perceives; see `Arena.perceive`."""
        return self.arena.perceive(view, agent)

    def observe(self, state: State) -> Observation:
        """What each robot perceives."""
        return jax.vmap(self.perceive, (None, 0))(self.view(state), jnp.arange(self.num_agents))

    def slots(self, state: State) -> dict[str, Int[Array, "agents slots"]]:
        """Which body of the scene is in which slot of `observe`."""
        return self.arena.slots()

    def scene(self, state: State) -> Scene:
        """See `Arena.scene`."""
        return self.arena.scene(state)


@pytree
class Clustering:
    """Robots are to sort boxes by colour (section 5.2.5 of the thesis); the defaults are those of figure 6.9.

    `amplified` rewards boxes of one colour for being close and colours for being apart, `corners` each box for being
    close to the corner of its colour. Colours are told apart by being `groups` of their own, as in the thesis's
    experiments, or by a `one-hot` after the features of each box, as in its text.
    """

    num_agents: int = static(default=10)
    num_boxes: int = static(default=4)
    side: float = 1.0
    episode_length: int = static(default=1024)
    num_clusters: int = static(default=2)
    reward: str = static(default="amplified")
    cluster_identity: str = static(default="groups")
    physics: str = static(default="faithful")
    active_boxes: NumberRange | None = static(default=None)

    action_dim: ClassVar[int] = 2

    def __post_init__(self) -> None:
        _check(self)
        require(self, ", ".join(REWARDS), lambda x: x in REWARDS, "reward")
        require(self, ", ".join(IDENTITIES), lambda x: x in IDENTITIES, "cluster_identity")
        most = min(self.num_boxes, len(CORNERS)) if self.reward == "corners" else self.num_boxes
        require(self, f"whole numbers from 1 to {most}", lambda x: is_whole(1)(x) and x <= most, "num_clusters")

    @property
    def cluster(self) -> tuple[int, ...]:
        """Of each box: the first boxes are of cluster 0, and so on, clusters differing by at most one in size."""
        parts = np.array_split(np.arange(self.num_boxes), self.num_clusters)
        return tuple(index for index, part in enumerate(parts) for _ in part)

    @property
    def arena(self) -> Arena:
        """The world that robots and boxes are in."""
        return Arena(self.side, self.num_agents, self.cluster, self.active_boxes, self.physics)

    def reset(self, key: Key) -> State:
        """See `Arena.reset`."""
        return self.arena.reset(key)

    def step(self, key: Key, state: State, action: Float[Array, "agents 2"]) -> tuple[State, Step]:
        """One step of 1 s; nothing in it is random.

        amplified, with means over pairs of present boxes and of the centroids of clusters that have any:

            reward = 20 (1.5 mean_c mean_{i<j in c} (d_ij before - d_ij after) + mean_{c<k} (D_ck after - D_ck before))

        corners, with c_i the corner of box i's cluster:

            reward = 20 sum_i (|p_i - c_i| before - |p_i - c_i| after)
        """
        after = self.arena.move(state, action)
        metrics = {
            "cluster_spread": _mean_within(self, _pairs(after.box_position), after.box_present),
            "cluster_separation": _mean(*_centroid_pairs(self, after)),
        }
        if self.reward == "corners":
            metrics["corner_distance"] = _mean(_to_corners(self, after.box_position), after.box_present)
        is_over = after.time >= self.episode_length
        step = Step(
            reward=REWARDS[self.reward](self, state, after),
            terminated=jnp.array(False),
            truncated=is_over,
            metrics=_now_and_finally(is_over, metrics),
        )
        return after, step

    def view(self, state: State) -> View:
        """What `perceive` needs of a state, in O(agents + boxes) memory."""
        return self.arena.view(state)

    def perceive(self, view: View, agent: Int[Array, ""]) -> Observation:
        """What one robot perceives; see `Arena.perceive`. Boxes come in groups `boxes_0, boxes_1, ...`, or in one."""
        obs = self.arena.perceive(view, agent)
        boxes = obs.groups["boxes"]
        if self.cluster_identity == "one-hot":
            identity = jax.nn.one_hot(jnp.array(self.cluster), self.num_clusters)
            boxes = Entities(jnp.concatenate([boxes.features, identity], -1), boxes.mask)
            return Observation(obs.own, obs.groups | {"boxes": boxes})
        groups = {name: Entities(boxes.features[part], boxes.mask[part]) for name, part in self._parts.items()}
        return Observation(obs.own, {"neighbors": obs.groups["neighbors"]} | groups)

    @property
    def _parts(self) -> dict[str, slice]:
        """The boxes of each group."""
        sizes = np.bincount(self.cluster)
        ends = enumerate(zip(np.cumsum(sizes), sizes, strict=True))
        return {f"boxes_{index}": slice(end - size, end) for index, (end, size) in ends}

    def observe(self, state: State) -> Observation:
        """What each robot perceives."""
        return jax.vmap(self.perceive, (None, 0))(self.view(state), jnp.arange(self.num_agents))

    def slots(self, state: State) -> dict[str, Int[Array, "agents slots"]]:
        """Which body of the scene is in which slot of `observe`."""
        slots = self.arena.slots()
        if self.cluster_identity == "one-hot":
            return slots
        groups = {name: slots["boxes"][:, part] for name, part in self._parts.items()}
        return {"neighbors": slots["neighbors"]} | groups

    def scene(self, state: State) -> Scene:
        """See `Arena.scene`; with the reward `corners` these are goals."""
        scene = self.arena.scene(state)
        if self.reward != "corners":
            return scene
        corners = jnp.array(CORNERS[: self.num_clusters]) * self.side
        return scene._replace(goals=Goals(corners, jnp.arange(self.num_clusters)))


def _within(task: Clustering, present: Bool[Array, "boxes"]) -> Bool[Array, "clusters boxes boxes"]:
    """Which pairs of present boxes are of which cluster."""
    member = _members(task, present)
    return member[:, None] & member[:, :, None] & ~jnp.eye(task.num_boxes, dtype=bool)[None]


def _members(task: Clustering, present: Bool[Array, "boxes"]) -> Bool[Array, "clusters boxes"]:
    """Which present boxes are of which cluster."""
    return (jnp.array(task.cluster)[None] == jnp.arange(task.num_clusters)[:, None]) & present[None]


def _centroid_pairs(
    task: Clustering, state: State
) -> tuple[Float[Array, "clusters clusters"], Bool[Array, "clusters clusters"]]:
    """Distances between the centroids of clusters, and for which pairs there are any."""
    member = _members(task, state.box_present)
    centroid = _mean(state.box_position[None], member[:, :, None], 1)
    exists = member.any(1)
    return _pairs(centroid), exists[:, None] & exists[None] & ~jnp.eye(task.num_clusters, dtype=bool)


def _mean_within(task: Clustering, values: Float[Array, "boxes boxes"], present: Array) -> Float[Array, ""]:
    """Mean over clusters of the mean over their pairs of boxes."""
    is_pair = _within(task, present)
    return _mean(_mean(values[None], is_pair, (1, 2)), is_pair.any((1, 2)))


def _to_corners(task: Clustering, position: Float[Array, "boxes 2"]) -> Float[Array, "boxes"]:
    """Distance of each box to the corner of its cluster."""
    corner = jnp.array(CORNERS)[jnp.array(task.cluster)] * task.side
    return norm(position - corner)


def _corners(task: Clustering, before: State, after: State) -> Float[Array, ""]:
    gain = _to_corners(task, before.box_position) - _to_corners(task, after.box_position)
    return 20 * jnp.where(after.box_present, gain, 0).sum()


def _amplified(task: Clustering, before: State, after: State) -> Float[Array, ""]:
    closer = _mean_within(task, _pairs(before.box_position) - _pairs(after.box_position), after.box_present)
    (before_distance, is_pair), (after_distance, _) = (_centroid_pairs(task, state) for state in (before, after))
    return 20 * (1.5 * closer + _mean(after_distance - before_distance, is_pair))


REWARDS = {"amplified": _amplified, "corners": _corners}
IDENTITIES = ("groups", "one-hot")
