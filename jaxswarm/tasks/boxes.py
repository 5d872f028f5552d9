"""Box tasks in one `Arena`: robots push all boxes together (assembly) or sort them by color (clustering)."""

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
from jaxswarm.types import Comparable, Entities, Key, Metrics, Observation, Step, pytree, static

MAX_BODIES = 1000  # robots or boxes; tables of all pairs are built when the physics is traced
CORNERS = ((-0.5, -0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, 0.5))  # corner of each cluster, in units of the side


def _pairwise_distances(position: Float[Array, "n 2"]) -> Float[Array, "n n"]:
    """Return the distances between all pairs of positions."""
    return norm(position[:, None] - position[None])


def _masked_mean(values: Float[Array, "*#n"], mask: Bool[Array, "*#n"], axis: int | tuple | None = None) -> Array:
    """Return the mean of the values where the mask is true, and 0 where it is true nowhere."""
    return jnp.where(mask, values, 0).sum(axis) / jnp.maximum(mask.sum(axis), 1)


def _with_final_values(is_over: Bool[Array, ""], metrics: Metrics) -> Metrics:
    """Add a metric `final_<name>` for each metric, which is NaN before the last step of an episode."""
    return metrics | {f"final_{name}": jnp.where(is_over, value, jnp.nan) for name, value in metrics.items()}


def _check_fields(task: "Assembly | Clustering") -> None:
    require(task, checks.integer(1), "episode_length")
    require(task, checks.size(1, MAX_BODIES), "num_agents", "num_boxes")
    fits_a_box = checks.Check(
        f"a finite number >= {2 * BOX_SIDE}, so that a box fits", lambda x: 2 * BOX_SIDE <= x < math.inf
    )
    require(task, fits_a_box, "side")
    require(task, checks.choice(rigid2d.PRESETS), "physics")
    require(task, checks.optional(checks.integer_range(1, task.num_boxes)), "active_boxes")


@pytree
class Assembly:
    """Assembly task of the thesis (section 5.2.4): robots push all boxes together.

    The figures of the thesis used the defaults. In Python, `null` is `None`.

    Attributes:
        num_agents: An environment has this number of robots, an integer >= 1.
        num_boxes: An environment has this number of boxes, an integer >= 1.
        side: The sides of the square arena have this length in meters; boxes have sides of 0.1 m.
        episode_length: An episode is truncated after this number of steps of 1 s, an integer >= 1.
        physics: The physics solver is "faithful" (10 substeps per step) or "fast" (5 substeps per step).
        active_boxes: The number of present boxes in each episode is drawn from [low, high]; with null all are present.
    """

    num_agents: int = static(default=10)
    num_boxes: int = static(default=4)
    side: float = 1.0
    episode_length: int = static(default=512)
    physics: str = static(default="faithful")
    active_boxes: NumberRange | None = static(default=None)

    action_dim: ClassVar[int] = 2
    comparable_metrics: ClassVar[tuple[Comparable, ...]] = (
        Comparable("final_box_distance", ("num_boxes", "active_boxes", "side")),
    )

    def __post_init__(self) -> None:
        _check_fields(self)

    @property
    def arena(self) -> Arena:
        """Arena with all boxes in one cluster."""
        return Arena(self.side, self.num_agents, (0,) * self.num_boxes, self.active_boxes, self.physics)

    def reset(self, key: Key) -> State:
        """Draw a start state; see `Arena.reset`."""
        return self.arena.reset(key)

    def step(self, key: Key, state: State, action: Float[Array, "agents 2"]) -> tuple[State, Step]:
        """Simulate one step of 1 s. The step is deterministic and ignores `key`.

            reward = sum_{i<j} (d_ij before - d_ij after)

        The d_ij are the distances in meters between the centers of present boxes, before and after the step.
        """
        next_state = self.arena.move(state, action)
        distance, next_distance = (_pairwise_distances(x.box_position) for x in (state, next_state))
        is_pair = state.box_present[:, None] & state.box_present[None] & ~jnp.eye(self.num_boxes, dtype=bool)
        is_over = jnp.asarray(next_state.time >= self.episode_length)
        step = Step(
            reward=jnp.where(is_pair, distance - next_distance, 0).sum() / 2,
            terminated=jnp.array(False),
            truncated=is_over,
            metrics=_with_final_values(is_over, {"box_distance": _masked_mean(next_distance, is_pair)}),
        )
        return next_state, step

    def view(self, state: State) -> View:
        """Return the part of a state that `perceive` needs, in O(agents + boxes) memory."""
        return self.arena.view(state)

    def perceive(self, view: View, agent: Int[Array, ""]) -> Observation:
        """Return the observation of one robot; `Arena.perceive` lists the features."""
        return self.arena.perceive(view, agent)

    def observe(self, state: State) -> Observation:
        """Return the observations of all robots; `Arena.perceive` lists the features."""
        return jax.vmap(self.perceive, (None, 0))(self.view(state), jnp.arange(self.num_agents))

    def slots(self, state: State) -> dict[str, Int[Array, "agents slots"]]:
        """Return the number of the scene's body in each slot of `observe`."""
        return self.arena.slots()

    def scene(self, state: State) -> Scene:
        """Return the scene of a state; see `Arena.scene`."""
        return self.arena.scene(state)


@pytree
class Clustering:
    """Clustering task of the thesis (section 5.2.5): robots sort boxes by color.

    The defaults are those of figure 6.9 of the thesis. The thesis's experiments used the cluster identity "groups", its
    text describes "one-hot". In Python, `null` is `None`.

    Attributes:
        num_agents: An environment has this number of robots, an integer >= 1.
        num_boxes: An environment has this number of boxes; the first boxes have the first color, and so on.
        side: The sides of the square arena have this length in meters; boxes have sides of 0.1 m.
        episode_length: An episode is truncated after this number of steps of 1 s, an integer >= 1.
        num_clusters: The boxes have this number of colors, at most 4 with the reward "corners".
        reward: The reward is "amplified" for close boxes of one color and distant colors, or "corners" for boxes close
            to the corner of their color.
        cluster_identity: Observations have one group of boxes per color ("groups") or mark the color by a "one-hot"
            after the features of each box.
        physics: The physics solver is "faithful" (10 substeps per step) or "fast" (5 substeps per step).
        active_boxes: The number of present boxes in each episode is drawn from [low, high]; with null all are present.
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
    comparable_metrics: ClassVar[tuple[Comparable, ...]] = (
        Comparable("final_cluster_spread", ("reward", "num_boxes", "active_boxes", "num_clusters", "side")),
    )

    def __post_init__(self) -> None:
        _check_fields(self)
        require(self, checks.choice(REWARDS), "reward")
        require(self, checks.choice(CLUSTER_IDENTITIES), "cluster_identity")
        most = min(self.num_boxes, len(CORNERS)) if self.reward == "corners" else self.num_boxes
        require(self, checks.integer(1, most), "num_clusters")

    @property
    def cluster(self) -> tuple[int, ...]:
        """Cluster index of each box: the first boxes are in cluster 0, the next in cluster 1, and so on.

        The sizes of clusters differ by at most one.
        """
        parts = np.array_split(np.arange(self.num_boxes), self.num_clusters)
        return tuple(index for index, part in enumerate(parts) for _ in part)

    @property
    def arena(self) -> Arena:
        """Arena with the boxes of all clusters."""
        return Arena(self.side, self.num_agents, self.cluster, self.active_boxes, self.physics)

    def reset(self, key: Key) -> State:
        """Draw a start state; see `Arena.reset`."""
        return self.arena.reset(key)

    def step(self, key: Key, state: State, action: Float[Array, "agents 2"]) -> tuple[State, Step]:
        """Simulate one step of 1 s. The step is deterministic and ignores `key`.

        The reward "amplified" has means over pairs of present boxes and over pairs of centroids of clusters with
        present boxes, where d_ij and D_ck are distances in meters:

            reward = 20 (1.5 mean_c mean_{i<j in c} (d_ij before - d_ij after) + mean_{c<k} (D_ck after - D_ck before))

        The reward "corners" has the corner c_i of the cluster of box i:

            reward = 20 sum_i (|p_i - c_i| before - |p_i - c_i| after)
        """
        next_state = self.arena.move(state, action)
        position, present = next_state.box_position, next_state.box_present
        metrics = {
            "cluster_spread": _mean_within_clusters(self, _pairwise_distances(position), present),
            "cluster_separation": _masked_mean(*_centroid_distances(self, next_state)),
        }
        if self.reward == "corners":
            metrics["corner_distance"] = _masked_mean(_corner_distances(self, position), present)
        is_over = jnp.asarray(next_state.time >= self.episode_length)
        step = Step(
            reward=REWARDS[self.reward](self, state, next_state),
            terminated=jnp.array(False),
            truncated=is_over,
            metrics=_with_final_values(is_over, metrics),
        )
        return next_state, step

    def view(self, state: State) -> View:
        """Return the part of a state that `perceive` needs, in O(agents + boxes) memory."""
        return self.arena.view(state)

    def perceive(self, view: View, agent: Int[Array, ""]) -> Observation:
        """Return the observation of one robot; `Arena.perceive` lists the features.

        Boxes are in the groups `boxes_0, boxes_1, ...`, one per cluster, or in the group `boxes` with a one-hot.
        """
        obs = self.arena.perceive(view, agent)
        boxes = obs.groups["boxes"]
        if self.cluster_identity == "one-hot":
            identity = jnp.where(boxes.mask[:, None], jax.nn.one_hot(jnp.array(self.cluster), self.num_clusters), 0)
            boxes = Entities(jnp.concatenate([boxes.features, identity], -1), boxes.mask)
            return Observation(obs.own, obs.groups | {"boxes": boxes})
        groups = {name: Entities(boxes.features[part], boxes.mask[part]) for name, part in self._box_slices.items()}
        return Observation(obs.own, {"neighbors": obs.groups["neighbors"]} | groups)

    @property
    def _box_slices(self) -> dict[str, slice]:
        """Slice of the boxes of each group, by the name of the group."""
        sizes = np.bincount(self.cluster)
        ends = enumerate(zip(np.cumsum(sizes), sizes, strict=True))
        return {f"boxes_{index}": slice(end - size, end) for index, (end, size) in ends}

    def observe(self, state: State) -> Observation:
        """Return the observations of all robots; see `perceive`."""
        return jax.vmap(self.perceive, (None, 0))(self.view(state), jnp.arange(self.num_agents))

    def slots(self, state: State) -> dict[str, Int[Array, "agents slots"]]:
        """Return the number of the scene's body in each slot of `observe`."""
        slots = self.arena.slots()
        if self.cluster_identity == "one-hot":
            return slots
        groups = {name: slots["boxes"][:, part] for name, part in self._box_slices.items()}
        return {"neighbors": slots["neighbors"]} | groups

    def scene(self, state: State) -> Scene:
        """Return the scene of a state; with the reward "corners", the corners are goals. See `Arena.scene`."""
        scene = self.arena.scene(state)
        if self.reward != "corners":
            return scene
        corners = jnp.array(CORNERS[: self.num_clusters]) * self.side
        return scene._replace(goals=Goals(corners, jnp.arange(self.num_clusters)))


def _pairs_within_clusters(task: Clustering, present: Bool[Array, "boxes"]) -> Bool[Array, "clusters boxes boxes"]:
    """Mark the pairs of present boxes of each cluster."""
    member = _members(task, present)
    return member[:, None] & member[:, :, None] & ~jnp.eye(task.num_boxes, dtype=bool)[None]


def _members(task: Clustering, present: Bool[Array, "boxes"]) -> Bool[Array, "clusters boxes"]:
    """Mark the present boxes of each cluster."""
    return (jnp.array(task.cluster)[None] == jnp.arange(task.num_clusters)[:, None]) & present[None]


def _centroid_distances(
    task: Clustering, state: State
) -> tuple[Float[Array, "clusters clusters"], Bool[Array, "clusters clusters"]]:
    """Return the distances between the centroids of clusters, and a mask of pairs of clusters with present boxes."""
    member = _members(task, state.box_present)
    centroid = _masked_mean(state.box_position[None], member[:, :, None], 1)
    exists = member.any(1)
    is_pair = exists[:, None] & exists[None] & ~jnp.eye(task.num_clusters, dtype=bool)
    return _pairwise_distances(centroid), is_pair


def _mean_within_clusters(task: Clustering, values: Float[Array, "boxes boxes"], present: Array) -> Float[Array, ""]:
    """Return the mean over clusters of the mean over their pairs of present boxes."""
    is_pair = _pairs_within_clusters(task, present)
    return _masked_mean(_masked_mean(values[None], is_pair, (1, 2)), is_pair.any((1, 2)))


def _corner_distances(task: Clustering, position: Float[Array, "boxes 2"]) -> Float[Array, "boxes"]:
    """Return the distance in meters of each box to the corner of its cluster."""
    corner = jnp.array(CORNERS)[jnp.array(task.cluster)] * task.side
    return norm(position - corner)


def _corners_reward(task: Clustering, state: State, next_state: State) -> Float[Array, ""]:
    gain = _corner_distances(task, state.box_position) - _corner_distances(task, next_state.box_position)
    return 20 * jnp.where(next_state.box_present, gain, 0).sum()


def _amplified_reward(task: Clustering, state: State, next_state: State) -> Float[Array, ""]:
    distance, next_distance = (_pairwise_distances(x.box_position) for x in (state, next_state))
    approach = _mean_within_clusters(task, distance - next_distance, next_state.box_present)
    (separation, is_pair), (next_separation, _) = (_centroid_distances(task, x) for x in (state, next_state))
    return 20 * (1.5 * approach + _masked_mean(next_separation - separation, is_pair))


REWARDS = {"amplified": _amplified_reward, "corners": _corners_reward}
CLUSTER_IDENTITIES = ("groups", "one-hot")
