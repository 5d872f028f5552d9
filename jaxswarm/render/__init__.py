"""Replays of policies as an offline HTML page, a strip of frames, an animation or a video.

Viewers depend on scenes, not on tasks.
"""

import html
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from jaxswarm.plot_settings import plot_settings
from jaxswarm.render import page, pictures
from jaxswarm.render.film import MAX_SHARES, Film, record
from jaxswarm.render.pictures import RenderError

__all__ = [
    "FORMATS",
    "MAX_SHARES",
    "Film",
    "RenderError",
    "check",
    "describe",
    "hook",
    "iframe",
    "of_seed",
    "record",
    "write",
    "write_replay",
]


def _write_page(path: Path, films: Sequence[Film]) -> None:
    path.write_text(page.html(films), encoding="utf-8")


FORMATS: dict[str, Callable[..., None]] = {
    ".html": _write_page,
    ".png": pictures.write_strip,
    ".gif": pictures.write_gif,
    ".mp4": pictures.write_mp4,
}
# Options of `write` for each format; their values are integers >= 1
OPTIONS = {".html": (), ".png": ("frames", "until"), ".gif": ("frames", "until"), ".mp4": ("until",)}


def check(path: Path, **options: int) -> None:
    """Check that `write` can write to `path` with these options, before films are recorded.

    Raises a `RenderError` for an unknown suffix, an option that does not fit the suffix, or a missing ffmpeg.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise RenderError(f"out: must end in one of {', '.join(FORMATS)}, got {str(path)!r}")
    for name in options:
        if name not in OPTIONS[suffix]:
            accepted = ", ".join(suffix for suffix, names in OPTIONS.items() if name in names)
            raise RenderError(f"{name}: must be used with {accepted}, got {suffix}")
    if suffix == ".mp4":
        pictures.find_ffmpeg()


def write(path: str | Path, films: Sequence[Film], **options: int) -> None:
    """Write films to a file in the format of its suffix.

    `OPTIONS` lists the options of each format. The file is replaced atomically. Raises a `RenderError` if the file
    cannot be written in this format; see `check`.
    """
    path = Path(path)
    check(path, **options)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        with plot_settings():
            FORMATS[path.suffix.lower()](temporary, films, **options)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def iframe(films: Sequence[Film], *, height: int = 760) -> str:
    """Return the page as an HTML iframe for notebooks: `IPython.display.HTML(iframe(films))`.

    `height` is in pixels.
    """
    style = "width: 100%; max-width: 1000px; border: 0"
    return f'<div><iframe srcdoc="{html.escape(page.html(films))}" height="{height}" style="{style}"></iframe></div>'


def describe(task: Any) -> str:
    """Return the name of the task and its number of agents, for titles."""
    return f"{type(task).__name__.lower()} of {task.num_agents} agents"


def of_seed(params: Any, index: int) -> Any:
    """Select the parameters of one of several vectorized seeds, leaves [seeds, ...]."""
    return jax.tree.map(lambda leaf: leaf[index], params)


def write_replay(run_dir: Path, experiment: Any, params: Any, *, update: int, name: str = "replay.html") -> Path | None:
    """Record an episode of a policy and write it as a page in the run folder.

    Returns the path of the page. A failure must not stop training: it prints a warning and returns `None`.
    """
    try:
        title = f"{describe(experiment.task)}, after update {update}"
        write(run_dir / name, [record(experiment.task, experiment.network, params, title=title)])
    except Exception as error:
        print(f"warning: no {name}: {type(error).__name__}: {error}", file=sys.stderr)
        return None
    return run_dir / name


def hook(run_dir: Path, experiment: Any, render_every: int) -> Callable[[int, Any], None]:
    """Return a callback for `fit` that writes a replay of the first seed's policy at some evaluations.

    These are the first evaluation, of the untrained policy, and every `render_every`-th one after it. The files are
    `replay-<update>.html` in the run folder.
    """

    def on_evaluation(update: int, params: Any) -> None:
        if update // experiment.eval_every % render_every == 0:
            write_replay(run_dir, experiment, of_seed(params, 0), update=update, name=f"replay-{update}.html")

    return on_evaluation
