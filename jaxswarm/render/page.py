"""Films as one HTML file that needs no network: JSON for what is small, and compressed numbers as text.

Positions take 16 bits a coordinate, headings 8 (1.4 degrees), shares 8: 0 is "not perceived", and 1 + 254 w^(1/4) a
share w, whose error is then below 3 % from 0.005 on. `replay.html` reads this again.
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

ABSENT = 65535  # as both coordinates of a body that does not take part
TYPES = {"u8": np.uint8, "u16": np.dtype("<u2"), "f32": np.dtype("<f4")}


def html(films: Sequence[Film]) -> str:
    """The page that plays films side by side, in step."""
    data, about = bytearray(), []
    for film in films:
        arrays = {}
        for name, (kind, numbers) in _arrays(film).items():
            arrays[name] = [len(data), len(data) + numbers.nbytes, kind]
            data += numbers.astype(TYPES[kind]).tobytes()
        about.append(_about(film) | {"arrays": arrays})
    text = json.dumps({"palette": {"light": LIGHT, "dark": DARK}, "films": about}, allow_nan=False)
    template = (Path(__file__).parent / "replay.html").read_text(encoding="utf-8")
    packed = base64.b64encode(zlib.compress(bytes(data), 6)).decode()
    return template.replace("{{about}}", text.replace("<", "\\u003c")).replace("{{data}}", packed)


def quantise_positions(
    position: Float[np.ndarray, "*n 2"],
    is_present: Bool[np.ndarray, "*n"],
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
) -> UInt16[np.ndarray, "*n 2"]:
    """0 to 65534 from the lower left to the upper right corner; `ABSENT` for those that do not take part."""
    share = np.clip((position - low) / (high - low), 0, 1)
    return np.where(is_present[..., None], np.rint(share * (ABSENT - 1)), ABSENT).astype(np.uint16)


def quantise_headings(heading: Float[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """256 to the circle."""
    return (np.rint(heading * (128 / math.pi)).astype(np.int64) % 256).astype(np.uint8)


def quantise_shares(shares: Float[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """See the head of this module."""
    is_seen = ~np.isnan(shares)
    root = np.sqrt(np.sqrt(np.where(is_seen, shares, 0.0)))
    return np.where(is_seen, 1 + np.rint(254 * np.clip(root, 0, 1)), 0).astype(np.uint8)


def _arrays(film: Film) -> dict[str, tuple[str, np.ndarray]]:
    arrays: dict[str, tuple[str, np.ndarray]] = {"score": ("f32", film.score.astype(np.float32))}
    for role, bodies in film.scenes.kinds.items():
        arrays[f"{role}.position"] = (
            "u16",
            quantise_positions(bodies.position, bodies.is_present, film.low, film.high),
        )
        if bodies.heading is not None:
            arrays[f"{role}.heading"] = ("u8", quantise_headings(bodies.heading))
    if film.shares is not None:
        arrays["shares"] = ("u8", quantise_shares(film.shares))
    return arrays


def _about(film: Film) -> dict[str, Any]:
    goals = film.scenes.goals
    return {
        "title": film.title,
        "frames": film.num_frames,
        "low": film.low.tolist(),
        "high": film.high.tolist(),
        "torus": bool(film.scenes.is_torus[0]),
        "kinds": {role: _about_kind(bodies) for role, bodies in film.scenes.kinds.items()},
        "goals": [
            {"x": float(x), "y": float(y), "group": int(group)}
            for (x, y), group in (zip(goals.position[0], goals.group[0], strict=True) if goals else ())
        ],
        "catches": [[frame, float(x), float(y)] for frame, (x, y) in film.catches],
        "trail": film.trail,
        "sharesEvery": film.shares_every,
    }


def _about_kind(bodies: Bodies) -> dict[str, Any]:
    """What stays the same during an episode."""
    within = float(bodies.seen_within[0])
    return {
        "count": bodies.position.shape[1],
        "size": float(bodies.size[0]),
        "group": None if bodies.group is None else bodies.group[0].tolist(),
        "seenWithin": within if math.isfinite(within) else None,
    }
