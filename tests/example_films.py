"""Films of random walks, for tests of pages and image files."""

import numpy as np

from jaxswarm.render.film import Film
from jaxswarm.scene import Bodies, Goals, Scene


def episode(num_frames=40, num_agents=6, num_boxes=0, num_evaders=0, shares=True, seed=0):
    """Return a film of random walks without a task; evaders have a catch at frame 7, boxes have groups and goals."""
    rng = np.random.default_rng(seed)

    def walk(number):
        return (50 + np.cumsum(rng.normal(size=(num_frames, number, 2)), 0)).clip(0, 100).astype(np.float32)

    def constant(value, number=None):
        return np.broadcast_to(np.asarray(value), (num_frames, number) if number else (num_frames, *np.shape(value)))

    def bodies(number, group=None, size=0.0, heading=True):
        angle = rng.uniform(-9, 9, (num_frames, number)) if heading else None
        is_present = np.ones((num_frames, number), bool)
        return Bodies(walk(number), is_present, angle, group, constant(size), constant(np.inf))

    group = constant(np.arange(num_boxes) % 3) if num_boxes else None
    is_caught = np.zeros((num_frames, num_evaders), bool)
    is_caught[7, :1] = True
    scenes = Scene(
        low=constant([0.0, 0.0]),
        high=constant([100.0, 100.0]),
        is_torus=constant(not num_boxes),
        agents=bodies(num_agents, size=2.0 if num_boxes else 0.0),
        evaders=bodies(num_evaders, heading=False) if num_evaders else None,
        boxes=bodies(num_boxes, group, 10.0) if num_boxes else None,
        goals=Goals(constant([[0.0, 0.0], [100.0, 100.0]]), constant([0, 1])) if num_boxes else None,
        is_caught=is_caught if num_evaders else None,
    )
    weights = rng.dirichlet(np.ones(scenes.num_bodies), (num_frames, num_agents)) if shares else None
    return Film("walk </script> <b>", scenes, np.cumsum(rng.normal(size=num_frames)), weights, 1)
