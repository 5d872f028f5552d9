"""What one picture contains, in world units and roles; NumPy only.

A task describes its states as scenes, and viewers draw scenes: neither knows the other. Scenes are named tuples, which
JAX takes for pytrees without being imported here; a film is one scene whose arrays have the frames as first axis.
"""

import math
from typing import Any, NamedTuple

import numpy as np

Numbers = Any  # NumPy arrays, or JAX arrays while a film is being computed


class Bodies(NamedTuple):
    """All things of one kind, also those that do not take part."""

    position: Numbers  # [n, 2], world units
    is_present: Numbers  # [n], bool
    heading: Numbers | None = None  # [n], rad, counter-clockwise from x; None: they look nowhere
    group: Numbers | None = None  # [n], whole numbers: what has the same belongs together; None: all do
    size: Numbers = 0.0  # radius of a disc or side of a square, world units; 0: a point, drawn large enough to be seen
    seen_within: Numbers = math.inf  # world units: how far agents see them


class Goals(NamedTuple):
    """Where the bodies of a group belong."""

    position: Numbers  # [goals, 2]
    group: Numbers  # [goals]


class Scene(NamedTuple):
    """A square world and what is in it at one time."""

    low: Numbers  # [2], the lower left corner
    high: Numbers  # [2]
    is_torus: Numbers  # bool: opposite sides are one place; else they are walls
    agents: Bodies
    evaders: Bodies | None = None
    boxes: Bodies | None = None  # oriented squares
    goals: Goals | None = None
    is_caught: Numbers | None = None  # [evaders], bool: caught at this time

    @property
    def kinds(self) -> dict[str, Bodies]:
        """Bodies by role, in the order in which they are numbered: first all agents, then evaders, then boxes."""
        roles = ("agents", "evaders", "boxes")
        return {role: bodies for role in roles if (bodies := getattr(self, role)) is not None}

    @property
    def num_bodies(self) -> int:
        """Of all kinds together; of a film, in each of its frames."""
        return sum(np.shape(bodies.position)[-2] for bodies in self.kinds.values())
