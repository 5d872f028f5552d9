"""Robots that push boxes: together (assembly), or apart by color (clustering); one world, `Arena`, two rewards."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxswarm import checks
from jaxswarm.checks import require
from jaxswarm.physics import rigid2d
from jaxswarm.physics.contacts import BOX_SIDE
from jaxswarm.physics.geometry import norm
from jaxswarm.scene import Goals, Scene
from jaxswarm.tasks.arena import Arena, State, View
from jaxswarm.tasks.swarm import NumberRange
from jaxswarm.types import Entities, Key, Metrics, Observation, Step, pytree, static

CORNERS = ((-0.5, -0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, 0.5))  # over the side; where clusters belong, in their order


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
    require(task, checks.integer(1), "num_agents", "num_boxes", "episode_length")
    fits_a_box = checks.Check(
        f"a finite number >= {2 * BOX_SIDE}, so that a box fits in", lambda x: 2 * BOX_SIDE <= x < math.inf
    )
    require(task, fits_a_box, "side")
    require(task, checks.choice(rigid2d.PRESETS), "physics")
    require(task, checks.optional(checks.integer_range(1, task.num_boxes)), "active_boxes")


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

        of the distances in meters between the centers of boxes.
        """
        after = self.arena.move(state, action)
        before_distance, after_distance = _pairs(state.box_position), _pairs(after.box_position)
        is_pair = state.box_present[:, None] & state.box_present[None] & ~jnp.eye(self.num_boxes, dtype=bool)
        is_over = jnp.asarray(after.time >= self.episode_length)
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
    """Robots are to sort boxes by color (section 5.2.5 of the thesis); the defaults are those of figure 6.9.

    `amplified` rewards boxes of one color for being close and colors for being apart, `corners` each box for being
    close to the corner of its color. Colors are told apart by being `groups` of their own, as in the thesis's
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
        require(self, checks.choice(REWARDS), "reward")
        require(self, checks.choice(IDENTITIES), "cluster_identity")
        most = min(self.num_boxes, len(CORNERS)) if self.reward == "corners" else self.num_boxes
        require(self, checks.integer(1, most), "num_clusters")

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
        is_over = jnp.asarray(after.time >= self.episode_length)
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
