"""Films as image files: strips of frames, GIF animations and MP4 videos.

Matplotlib draws the frames in the colors of the HTML page.
"""

import math
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from jaxswarm.render.film import LIGHT, Film
from jaxswarm.scene import Bodies

INK, QUIET, FAINT = "#1c2126", "#646b73", "#c3c7cb"
STRIP_WIDTH, VIDEO_WIDTH = 2.2, 3.6  # inches per frame
STRIP_RESOLUTION, VIDEO_RESOLUTION = 200, 100  # dots per inch
GIF_RATE, MP4_RATE = 20, 30  # frames per second
GIF_COLORS = 64
POINT_RADIUS = 0.019  # in units of the side of the world
JUMP = 0.12  # in units of the side: longer moves in one step cross a seam or are a restart, and leave no trail
KITE = np.array([[1.5, 0.0], [-1.0, 0.9], [-0.45, 0.0], [-1.0, -0.9]])  # in units of the radius, heading along x
SQUARE = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
CIRCLE = np.stack([np.cos(np.linspace(0, 2 * math.pi, 24)), np.sin(np.linspace(0, 2 * math.pi, 24))], -1)
NOSE = np.array([[0.2, 0.16], [0.2, -0.16], [0.95, -0.16], [0.95, 0.16]])


class RenderError(RuntimeError):
    """Raised when a replay cannot be written; the message gives the cause and the possible options."""


def write_strip(path: Path, films: Sequence[Film], *, frames: int = 6, until: int | None = None) -> None:
    """Write a PNG image with one row of `frames` evenly spaced frames per film.

    The frames are between the first step and the step `until`, or the end of the longest film.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415

    steps = _steps(films, frames, until)
    figure = Figure(figsize=(STRIP_WIDTH * len(steps), (STRIP_WIDTH + 0.25) * len(films)), layout="constrained")
    for film, row in zip(films, figure.subplots(len(films), len(steps), squeeze=False), strict=True):
        for step, axes in zip(steps, row, strict=True):
            shown = min(step, film.num_frames - 1)
            draw(axes, film, shown)
            axes.set_title(f"step {shown}" + (" (end)" if shown < step else ""), fontsize=9, color=QUIET, pad=4)
        if len(films) > 1:
            row[0].set_ylabel(film.title, fontsize=7, color=INK)
    figure.savefig(path, dpi=STRIP_RESOLUTION, format="png")


def write_gif(path: Path, films: Sequence[Film], *, frames: int = 150, until: int | None = None) -> None:
    """Write a GIF animation of at most `frames` evenly spaced frames up to the step `until`.

    All frames share one palette and are not dithered, which keeps the file small.
    """
    from PIL import Image  # noqa: PLC0415

    steps = _steps(films, frames, until)
    images = [Image.fromarray(frame) for frame in _video_frames(films, steps)]
    few = images[:: max(len(images) // 4, 1)]
    sample = Image.fromarray(np.concatenate([np.asarray(image) for image in few], 1))
    palette = sample.quantize(GIF_COLORS, dither=Image.Dither.NONE)
    first, *rest = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration = [1000 // GIF_RATE] * len(rest) + [1500]  # ms; the last frame stays longer before the loop restarts
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=duration, loop=0, optimize=True)


def write_mp4(path: Path, films: Sequence[Film], *, until: int | None = None) -> None:
    """Write an MP4 video of every step up to the step `until`, encoded by ffmpeg.

    Raises a `RenderError` if ffmpeg is missing or fails.
    """
    steps = _steps(films, max(film.num_frames for film in films), until)
    width, height = round(VIDEO_WIDTH * len(films) * VIDEO_RESOLUTION), _video_height()
    source = f"-f rawvideo -pixel_format rgb24 -video_size {width}x{height} -framerate {MP4_RATE} -i -"
    target = "-c:v libx264 -crf 20 -pix_fmt yuv420p -movflags +faststart -f mp4"
    command = [find_ffmpeg(), "-y", "-loglevel", "error", *source.split(), *target.split(), str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin
        assert process.stderr
        try:
            for frame in _video_frames(films, steps):
                process.stdin.write(frame.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # ffmpeg has failed, and its message is read below
        message = process.stderr.read().decode(errors="replace")
    if process.returncode:
        raise RenderError(f"ffmpeg could not write {path}: {message.strip()}")


def find_ffmpeg() -> str:
    """Return the path of ffmpeg; raises a `RenderError` if it is not installed."""
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        raise RenderError("out: must end in .html, .gif or .png if ffmpeg is not installed, got .mp4")
    return ffmpeg


def draw(axes: Any, film: Film, frame: int) -> None:
    """Draw one frame: the world, goals, trails, catches so far, and bodies."""
    from matplotlib.patches import Circle  # noqa: PLC0415

    side = float(film.high[0] - film.low[0])
    axes.set(xlim=(film.low[0], film.high[0]), ylim=(film.low[1], film.high[1]), xticks=[], yticks=[], aspect="equal")
    is_torus = bool(film.scenes.is_torus[0])
    for spine in axes.spines.values():
        spine.set(color=FAINT if is_torus else QUIET, linewidth=0.8 if is_torus else 1.4)
        spine.set_linestyle((0, (4, 4)) if is_torus else "solid")
    if film.scenes.goals:
        for position, group in zip(film.scenes.goals.position[0], film.scenes.goals.group[0], strict=True):
            color = LIGHT["groups"][group % 4]
            axes.add_patch(Circle(position, 0.17 * side, facecolor=color + "33", edgecolor=color, linewidth=1))
    for role, bodies in film.scenes.kinds.items():
        _draw_trails(axes, film, role, bodies, frame)
    past = [position for catch_frame, position in film.catches if catch_frame <= frame]
    if past:
        axes.scatter(*np.transpose(past), s=26, marker="x", color=LIGHT["caught"], linewidth=1.8, zorder=4)
    for role, bodies in reversed(film.scenes.kinds.items()):
        _draw_bodies(axes, film, role, bodies, frame)


def _draw_trails(axes: Any, film: Film, role: str, bodies: Bodies, frame: int) -> None:
    """Draw lines through the preceding positions; older lines are fainter."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415
    from matplotlib.colors import to_rgb  # noqa: PLC0415

    side = float(film.high[0] - film.low[0])
    start = max(frame - film.trail, 0)
    path = bodies.position[start : frame + 1]
    lines = np.stack([path[:-1], path[1:]], 2)  # [steps, bodies, 2 ends, 2]
    is_drawn = np.linalg.norm(lines[:, :, 1] - lines[:, :, 0], axis=-1) < JUMP * side
    is_drawn &= bodies.is_present[start:frame]
    age = np.broadcast_to((frame - np.arange(start, frame))[:, None], is_drawn.shape)
    rgb = np.array([to_rgb(color) for color in _colors(role, bodies, frame)])
    rgb = np.broadcast_to(rgb, (*is_drawn.shape, 3))
    alpha = 0.1 + 0.7 * (1 - age / (film.trail + 1)) ** 2
    rgba = np.concatenate([rgb, alpha[..., None]], -1)
    axes.add_collection(LineCollection(list(lines[is_drawn]), colors=rgba[is_drawn], linewidths=1.0, zorder=2))


def _draw_bodies(axes: Any, film: Film, role: str, bodies: Bodies, frame: int) -> None:
    """Draw points with a heading as arrowheads, other agents as discs, and boxes as squares.

    Boxes have dots that show their group in black-and-white prints.
    """
    from matplotlib.collections import PolyCollection  # noqa: PLC0415

    side, shrink = float(film.high[0] - film.low[0]), math.sqrt(20 / max(20, film.scenes.num_bodies))
    size = float(bodies.size[frame]) * (0.5 if role == "boxes" else 1.0) or POINT_RADIUS * shrink * side
    is_pointed = bodies.heading is not None and not bodies.size[frame]
    outline = SQUARE if role == "boxes" else KITE if is_pointed else CIRCLE
    is_present = bodies.is_present[frame]
    position = bodies.position[frame][is_present]
    heading = np.zeros(len(position)) if bodies.heading is None else bodies.heading[frame][is_present]
    colors = np.array(_colors(role, bodies, frame))[is_present]
    shapes = list(_place(outline, position, heading, size))
    axes.add_collection(PolyCollection(shapes, facecolors=colors, edgecolors="white", linewidths=0.5, zorder=3))
    if role == "agents" and not is_pointed:
        noses = list(_place(NOSE, position, heading, size))
        axes.add_collection(PolyCollection(noses, facecolors="white", zorder=3))
    if role == "boxes" and bodies.group is not None and bodies.group[frame].any():
        dots = _dots(bodies.group[frame][is_present], position, size)
        axes.add_collection(PolyCollection(dots, facecolors=INK, zorder=3))


def _place(
    outline: Float[np.ndarray, "points 2"],
    position: Shaped[np.ndarray, "n 2"],
    heading: Shaped[np.ndarray, " n"],
    size: float,
) -> Shaped[np.ndarray, "n points 2"]:
    """Scale an outline, and turn and move it to each heading and position."""
    cos, sin = np.cos(heading), np.sin(heading)
    rotation = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    return position[:, None] + size * np.einsum("nij,pj->npi", rotation, outline)


def _dots(group: Shaped[np.ndarray, " n"], position: Shaped[np.ndarray, "n 2"], size: float) -> list[np.ndarray]:
    """Return the outlines of dots in a row: one dot for a box of group 0, two for a box of group 1, and so on."""
    centers = [
        box + np.array([(dot - number / 2) * 0.5 * size, 0.0])
        for box, number in zip(position, group, strict=True)
        for dot in range(number + 1)
    ]
    return [center + 0.15 * size * CIRCLE for center in centers]


def _colors(role: str, bodies: Bodies, frame: int) -> list[str]:
    """Return the color of each body."""
    if role != "boxes":
        return [LIGHT[role]] * bodies.position.shape[1]
    groups = np.zeros(bodies.position.shape[1], int) if bodies.group is None else bodies.group[frame]
    return [LIGHT["groups"][group % 4] for group in groups]


def _steps(films: Sequence[Film], number: int, until: int | None) -> list[int]:
    """Return at most `number` evenly spaced distinct steps, including the first and the last."""
    last = max(film.num_frames for film in films) - 1
    last = min(until, last) if until else last
    return sorted({round(x) for x in np.linspace(0, last, min(number, last + 1))})


def _video_height() -> int:
    return round((VIDEO_WIDTH + 0.3) * VIDEO_RESOLUTION)


def _video_frames(films: Sequence[Film], steps: Sequence[int]) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield images of films side by side, with step and return above; width and height are even."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(VIDEO_WIDTH * len(films), VIDEO_WIDTH + 0.3), dpi=VIDEO_RESOLUTION)
    canvas = FigureCanvasAgg(figure)
    grid = figure.subplots(1, len(films), squeeze=False)[0]
    low, high = 0.02, 1 - 0.3 / (VIDEO_WIDTH + 0.3)
    figure.subplots_adjust(left=0.02 / len(films), right=1 - 0.02 / len(films), bottom=low, top=high, wspace=0.04)
    for step in steps:
        for film, axes in zip(films, grid, strict=True):
            axes.clear()
            shown = min(step, film.num_frames - 1)
            draw(axes, film, shown)
            axes.set_title(f"step {shown}", fontsize=9, color=QUIET, loc="left", pad=4)
            axes.set_title(f"return {film.score[shown]:.1f}", fontsize=9, color=INK, loc="right", pad=4)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
