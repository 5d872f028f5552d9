"""The square world of robots that push boxes: how it starts, how it moves, and what robots perceive of it.

A robot is a disc, and a box a square, of `rigid2d`; the world has its center at the origin, with x and y in
[-side/2, side/2].
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxswarm.physics import rigid2d
from jaxswarm.physics.contacts import BOX_SIDE, DISC_RADIUS, MAX_SPEED, MAX_TURN_RATE
from jaxswarm.physics.geometry import bearing, direction, norm, unit_vector
from jaxswarm.scene import Bodies, Scene
from jaxswarm.tasks.swarm import NumberRange, cyclic_others, draw_number
from jaxswarm.types import Entities, Key, Observation, pytree, static

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
        heading_vector = direction(state.heading)
        fraction = jnp.full((self.num_agents, 1), state.box_present.mean())
        return View(
            position=state.position,
            direction=heading_vector,
            own=jnp.concatenate([state.position, heading_vector[:, ::-1], fraction], -1),
            box_position=state.box_position,
            box_direction=direction(state.box_heading),
            box_present=state.box_present,
        )

    def perceive(self, view: View, agent: Int[Array, ""]) -> Observation:
        """What one robot perceives; groups are `neighbors`, in cyclic order from the robot after it on, and `boxes`.

        Own features: x, y, [sin, cos] of the heading, fraction of the boxes that is present. Of neighbors and boxes:
        distance, [sin, cos] of the counter-clockwise bearing to them, and of their heading less one's own; of boxes
        also x, y. All in meters.
        """

        def window(leaf: Array, start: Array, size: int) -> Array:
            return jax.lax.dynamic_slice_in_dim(jnp.concatenate([leaf, leaf]), start, size)

        def seen(position: Array, heading: Array) -> Array:
            displacement = position - my_position
            distance = norm(displacement)
            toward = unit_vector(displacement, distance)
            return jnp.concatenate(
                [distance[:, None], _turn(heading_vector, toward), _turn(heading_vector, heading)], -1
            )

        my_position, heading_vector = window(view.position, agent, 1), window(view.direction, agent, 1)
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
        return {"neighbors": jax.vmap(cyclic_others, (0, None))(robots, self.num_agents), "boxes": boxes}

    def scene(self, state: State) -> Scene:
        """Discs and squares between walls; boxes are grouped by cluster."""
        robots = Bodies(state.position, jnp.ones(self.num_agents, bool), state.heading, size=DISC_RADIUS)
        cluster = jnp.array(self.cluster)
        boxes = Bodies(state.box_position, state.box_present, state.box_heading, cluster, size=BOX_SIDE)
        corner = jnp.full(2, self.side / 2)
        return Scene(-corner, corner, False, robots, boxes=boxes)


def _turn(heading_vector: Float[Array, "*#n 2"], toward: Float[Array, "*#n 2"]) -> Float[Array, "*n 2"]:
    """[sin, cos] of the counter-clockwise angle from `ahead` to `toward`."""
    return bearing(heading_vector, toward)[:, ::-1] * jnp.array([[-1.0, 1.0]])
