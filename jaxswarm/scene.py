"""Scenes: what a viewer draws for one state of a task, in world units. This module imports only NumPy.

Tasks convert states to scenes and viewers draw scenes, so that tasks and viewers do not depend on each other. Scenes
are named tuples, which JAX treats as pytrees without an import here. A film stores one scene whose arrays have a
leading axis of frames.
"""

import math
from typing import Any, NamedTuple

import numpy as np

Numbers = Any  # NumPy arrays, or JAX arrays while a film is computed


class Bodies(NamedTuple):
    """All bodies of one kind, active or not."""

    position: Numbers  # [n, 2], world units
    is_present: Numbers  # [n], bool, false for inactive bodies
    heading: Numbers | None = None  # [n], rad, counter-clockwise from x; None: bodies without a heading
    group: Numbers | None = None  # [n], integers: equal numbers form a group; None: a single group
    size: Numbers = 0.0  # radius of a disc or side of a square, world units; 0: a point, drawn with a minimum size
    seen_within: Numbers = math.inf  # distance in world units up to which agents perceive these bodies


class Goals(NamedTuple):
    """Goal positions for groups of bodies."""

    position: Numbers  # [goals, 2], world units
    group: Numbers  # [goals], integers that match `Bodies.group`


class Scene(NamedTuple):
    """A square world and its bodies at one time."""

    low: Numbers  # [2], lower left corner, world units
    high: Numbers  # [2], upper right corner, world units
    is_torus: Numbers  # bool: opposite sides are connected if true, and walls if false
    agents: Bodies
    evaders: Bodies | None = None
    boxes: Bodies | None = None  # oriented squares
    goals: Goals | None = None
    is_caught: Numbers | None = None  # [evaders], bool, true for evaders that are caught at this time

    @property
    def kinds(self) -> dict[str, Bodies]:
        """Bodies by role, in the order of their numbers in the scene: agents, then evaders, then boxes."""
        roles = ("agents", "evaders", "boxes")
        return {role: bodies for role in roles if (bodies := getattr(self, role)) is not None}

    @property
    def num_bodies(self) -> int:
        """Number of bodies of all kinds, in one frame."""
        return sum(np.shape(bodies.position)[-2] for bodies in self.kinds.values())
