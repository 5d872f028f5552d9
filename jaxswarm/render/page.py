"""Films as one offline HTML file, with metadata as JSON and arrays as compressed base64 text.

Positions have 16 bits per coordinate, headings 8 bits (1.4 degrees) and shares 8 bits. The share code 0 means "not
perceived"; a share w has the code 1 + 254 w^(1/4), with an error below 3 % for w >= 0.005. `replay.html` decodes them.
"""

import base64
import json
import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from jaxswarm.render.film import DARK, LIGHT, Film
from jaxswarm.scene import Bodies

ABSENT = 65535  # code of both coordinates of an inactive body
TYPES = {"u8": np.uint8, "u16": np.dtype("<u2"), "f32": np.dtype("<f4")}


def html(films: Sequence[Film]) -> str:
    """Return the HTML text of a page that plays films side by side and synchronously."""
    data, metadata = bytearray(), []
    for film in films:
        arrays = {}
        for name, (dtype, numbers) in _arrays(film).items():
            arrays[name] = [len(data), len(data) + numbers.nbytes, dtype]
            data += numbers.astype(TYPES[dtype]).tobytes()
        metadata.append(_metadata(film) | {"arrays": arrays})
    text = json.dumps({"palette": {"light": LIGHT, "dark": DARK}, "films": metadata}, allow_nan=False)
    template = (Path(__file__).parent / "replay.html").read_text(encoding="utf-8")
    packed = base64.b64encode(zlib.compress(bytes(data), 6)).decode()
    return template.replace("{{metadata}}", text.replace("<", "\\u003c")).replace("{{data}}", packed)


def quantize_positions(
    position: Float[np.ndarray, "*n 2"],
    is_present: Bool[np.ndarray, "*n"],
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
) -> UInt16[np.ndarray, "*n 2"]:
    """Encode positions as 0 to 65534 from the lower left to the upper right corner, and inactive bodies as `ABSENT`."""
    fraction = np.clip((position - low) / (high - low), 0, 1)
    return np.where(is_present[..., None], np.rint(fraction * (ABSENT - 1)), ABSENT).astype(np.uint16)


def quantize_headings(heading: Float[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Encode headings in rad with 256 codes for a full turn."""
    return (np.rint(heading * (128 / math.pi)).astype(np.int64) % 256).astype(np.uint8)


def quantize_shares(shares: Float[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Encode shares in [0, 1] as 1 to 255, and NaN (not perceived) as 0; the module docstring has the formula."""
    is_seen = ~np.isnan(shares)
    root = np.sqrt(np.sqrt(np.where(is_seen, shares, 0.0)))
    return np.where(is_seen, 1 + np.rint(254 * np.clip(root, 0, 1)), 0).astype(np.uint8)


def _arrays(film: Film) -> dict[str, tuple[str, np.ndarray]]:
    arrays: dict[str, tuple[str, np.ndarray]] = {"score": ("f32", film.score.astype(np.float32))}
    for role, bodies in film.scenes.kinds.items():
        arrays[f"{role}.position"] = (
            "u16",
            quantize_positions(bodies.position, bodies.is_present, film.low, film.high),
        )
        if bodies.heading is not None:
            arrays[f"{role}.heading"] = ("u8", quantize_headings(bodies.heading))
    if film.shares is not None:
        arrays["shares"] = ("u8", quantize_shares(film.shares))
    return arrays


def _metadata(film: Film) -> dict[str, Any]:
    goals = film.scenes.goals
    return {
        "title": film.title,
        "frames": film.num_frames,
        "low": film.low.tolist(),
        "high": film.high.tolist(),
        "torus": bool(film.scenes.is_torus[0]),
        "kinds": {role: _kind_metadata(bodies) for role, bodies in film.scenes.kinds.items()},
        "goals": [
            {"x": float(x), "y": float(y), "group": int(group)}
            for (x, y), group in (zip(goals.position[0], goals.group[0], strict=True) if goals else ())
        ],
        "catches": [[frame, float(x), float(y)] for frame, (x, y) in film.catches],
        "trail": film.trail,
        "sharesEvery": film.shares_every,
    }


def _kind_metadata(bodies: Bodies) -> dict[str, Any]:
    """Return the properties of bodies that are constant during an episode."""
    within = float(bodies.seen_within[0])
    return {
        "count": bodies.position.shape[1],
        "size": float(bodies.size[0]),
        "group": None if bodies.group is None else bodies.group[0].tolist(),
        "seenWithin": within if math.isfinite(within) else None,
    }
