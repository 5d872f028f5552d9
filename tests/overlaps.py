"""Oracle of the overlaps of discs, squares and walls, in float64, for arrays with any leading axes."""

import itertools

import numpy as np

RADIUS, HALF = 0.0165, 0.05


def overlaps(state, side):
    """Return the deepest overlap of each kind of pair, in meters, over all states."""
    disc, box = np.float64(state.position), np.float64(state.box_position)
    angle = np.float64(state.box_heading)
    discs, boxes = range(disc.shape[-2]), range(box.shape[-2])
    axes = np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([-np.sin(angle), np.cos(angle)], -1)
    reach = HALF * np.abs(np.stack(axes)).sum(0)  # of a box along x and along y
    found = {
        "disc_disc": [
            2 * RADIUS - np.linalg.norm(disc[..., i, :] - disc[..., j, :], axis=-1)
            for i, j in itertools.combinations(discs, 2)
        ],
        "disc_box": [_disc_in_box(disc[..., i, :] - box[..., j, :], axes, j) for i in discs for j in boxes],
        "box_box": [_box_in_box(box, angle, i, j) for i, j in itertools.combinations(boxes, 2)],
        "disc_wall": [np.abs(disc) + RADIUS - side / 2],
        "box_wall": [np.abs(box) + reach - side / 2],
    }
    return {kind: np.max(depths) if np.size(depths) else -np.inf for kind, depths in found.items()}


def _disc_in_box(displacement, axes, box):
    outside = np.abs(np.stack([(displacement * axis[..., box, :]).sum(-1) for axis in axes], -1)) - HALF
    distance = np.linalg.norm(np.maximum(outside, 0), axis=-1)
    return RADIUS - np.where(distance > 0, distance, outside.max(-1))


def _box_in_box(position, angle, i, j):
    """Test the separating axes of both squares; along each, a square reaches half a side times |cos| + |sin|."""
    displacement = position[..., j, :] - position[..., i, :]
    gaps = []
    for one, other, turn in itertools.product((i,), (j,), (0, np.pi / 2)):
        for direction in (angle[..., one] + turn, angle[..., other] + turn):
            along = np.cos(direction) * displacement[..., 0] + np.sin(direction) * displacement[..., 1]
            turned = angle[..., other] - angle[..., one]
            gaps.append(np.abs(along) - HALF * (1 + np.abs(np.cos(turned)) + np.abs(np.sin(turned))))
    return -np.max(gaps, 0)
