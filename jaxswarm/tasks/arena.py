"""Square arena in which robots push boxes: start states, motion and observations.

Robots are discs and boxes are squares, simulated by `physics.rigid2d`. The center of the arena is the origin, and x
and y are in [-side/2, side/2].
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
from jaxswarm.types import Entities, Key, Observation, clip_action, pytree, static

START_MARGIN = 0.02  # m, distance from the walls that robots keep in start states
BOX_START_FRACTION = 0.7  # fraction of the side within which boxes start
SETTLE_SUBSTEPS = 6  # substeps before an episode; they leave overlaps like the one Box2D step in the thesis's program


@pytree
class State:
    """State of one environment, drawn by `reset` and advanced by `step`."""

    position: Float[Array, "agents 2"]  # m
    heading: Float[Array, "agents"]  # rad, counter-clockwise from x
    box_position: Float[Array, "boxes 2"]  # m
    box_heading: Float[Array, "boxes"]  # rad
    box_velocity: Float[Array, "boxes 3"]  # x and y in m / s, turn rate in rad / s
    box_present: Bool[Array, "boxes"]  # absent boxes are not perceived, touched or rewarded
    time: Int[Array, ""]  # steps since reset


@pytree
class View:
    """Quantities computed once per robot and box, so that features of a pair need no trigonometry."""

    position: Float[Array, "agents 2"]  # m
    direction: Float[Array, "agents 2"]  # [cos, sin] of the heading
    own: Float[Array, "agents 5"]
    box_position: Float[Array, "boxes 2"]  # m
    box_direction: Float[Array, "boxes 2"]  # [cos, sin] of the heading
    box_present: Bool[Array, "boxes"]


@pytree
class Arena:
    """Arena shared by both box tasks: start states, motion and observations."""

    side: float  # m
    num_agents: int = static()
    cluster: tuple[int, ...] = static()  # cluster index of each box
    active_boxes: NumberRange | None = static()  # range of the number of present boxes; None: all boxes
    physics: str = static()  # a name in `rigid2d.PRESETS`

    @property
    def num_boxes(self) -> int:
        """Largest number of boxes that can be present."""
        return len(self.cluster)

    def reset(self, key: Key) -> State:
        """Draw a start state: robots uniform in the arena, boxes uniform in its middle, all with uniform headings.

        A few substeps of physics then remove most overlaps.
        """
        position_key, heading_key, box_position_key, box_heading_key, number_key = jax.random.split(key, 5)

        def uniform(key: Key, bound: float | Array, *shape: int) -> Array:
            return bound * jax.random.uniform(key, shape, minval=-1.0)

        position = uniform(position_key, self.side / 2, self.num_agents, 2)
        limit = self.side / 2 - START_MARGIN
        number = draw_number(number_key, self.active_boxes, self.num_boxes)
        state = State(
            position=jnp.clip(position, -limit, limit),
            heading=uniform(heading_key, math.pi, self.num_agents),
            box_position=uniform(box_position_key, BOX_START_FRACTION * self.side / 2, self.num_boxes, 2),
            box_heading=uniform(box_heading_key, math.pi, self.num_boxes),
            box_velocity=jnp.zeros((self.num_boxes, 3)),
            box_present=jnp.asarray(self.activation_rank()) < number,
            time=jnp.zeros((), jnp.int32),
        )
        return rigid2d.settle(rigid2d.PRESETS[self.physics], self.side, state, SETTLE_SUBSTEPS)

    def activation_rank(self) -> np.ndarray:
        """Return the rank `[boxes]` in which boxes become present: the first box of each cluster, then the second, ...

        With n present boxes, those with a rank below n are present.
        """
        cluster = np.array(self.cluster)
        rank = np.array([(cluster[:box] == cluster[box]).sum() for box in range(self.num_boxes)])
        return np.argsort(np.lexsort((cluster, rank)))

    def move(self, state: State, action: Float[Array, "agents 2"]) -> State:
        """Return the state 1 s later. Actions are clipped to [-1, 1].

        An action a sets the speed v and the turn rate w of a robot:

            v = 0.005 (a_0 + 1) m / s
            w = pi / 2 a_1 rad / s
        """
        action = clip_action(action)
        speed, turn_rate = MAX_SPEED / 2 * (action[:, 0] + 1), MAX_TURN_RATE * action[:, 1]
        command = jnp.stack([speed, turn_rate], -1)
        state = rigid2d.move(rigid2d.PRESETS[self.physics], self.side, state, command)
        return dataclasses.replace(state, time=state.time + 1)

    def view(self, state: State) -> View:
        """Return the part of a state that `perceive` needs."""
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
        """Return the observation of one robot, with the groups `neighbors` and `boxes`.

        Neighbors are in cyclic order, starting with the robot after this one. Own features: x, y, [sin, cos] of the
        heading, and the fraction of boxes that is present. Features of neighbors and boxes: distance, [sin, cos] of
        the counter-clockwise bearing to them, and [sin, cos] of their heading minus the robot's own. Boxes also have
        x and y. Lengths are in meters.
        """

        def window(leaf: Array, start: Array, size: int) -> Array:
            return jax.lax.dynamic_slice_in_dim(jnp.concatenate([leaf, leaf]), start, size)

        def features(position: Array, heading: Array) -> Array:
            displacement = position - my_position
            distance = norm(displacement)
            toward = unit_vector(displacement, distance)
            return jnp.concatenate(
                [distance[:, None], _sin_cos(heading_vector, toward), _sin_cos(heading_vector, heading)], -1
            )

        my_position, heading_vector = window(view.position, agent, 1), window(view.direction, agent, 1)
        num_others = self.num_agents - 1
        others = features(window(view.position, agent + 1, num_others), window(view.direction, agent + 1, num_others))
        boxes = jnp.concatenate([features(view.box_position, view.box_direction), view.box_position], -1)
        present = view.box_present
        groups = {
            "neighbors": Entities(features=others, mask=jnp.ones(num_others, bool)),
            "boxes": Entities(features=jnp.where(present[:, None], boxes, 0), mask=present),
        }
        return Observation(own=window(view.own, agent, 1)[0], groups=groups)

    def slots(self) -> dict[str, Int[Array, "agents slots"]]:
        """Return the number of the scene's body in each slot of `perceive`, for all robots."""
        robots = jnp.arange(self.num_agents)
        boxes = jnp.broadcast_to(self.num_agents + jnp.arange(self.num_boxes), (self.num_agents, self.num_boxes))
        return {"neighbors": jax.vmap(cyclic_others, (0, None))(robots, self.num_agents), "boxes": boxes}

    def scene(self, state: State) -> Scene:
        """Return the scene of a state: discs and squares between walls, with boxes grouped by cluster."""
        robots = Bodies(state.position, jnp.ones(self.num_agents, bool), state.heading, size=DISC_RADIUS)
        cluster = jnp.array(self.cluster)
        boxes = Bodies(state.box_position, state.box_present, state.box_heading, cluster, size=BOX_SIDE)
        corner = jnp.full(2, self.side / 2)
        return Scene(-corner, corner, False, robots, boxes=boxes)


def _sin_cos(heading_vector: Float[Array, "*#n 2"], toward: Float[Array, "*#n 2"]) -> Float[Array, "*n 2"]:
    """Return [sin, cos] of the counter-clockwise angle from `heading_vector` to `toward`."""
    return bearing(heading_vector, toward)[:, ::-1] * jnp.array([[-1.0, 1.0]])
