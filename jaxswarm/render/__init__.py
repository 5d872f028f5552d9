"""Pictures of policies at work: one offline page, a strip, a moving picture. Viewers know scenes, not tasks."""

import html
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

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
# What `write` may be told of each format, whole numbers from 1
OPTIONS = {".html": (), ".png": ("frames", "until"), ".gif": ("frames", "until"), ".mp4": ("until",)}


def check(path: Path, **options: int) -> None:
    """Raises a `RenderError` for what `write` could not do, before any time is spent on films."""
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
    """Writes films in the format of the suffix, as a whole or not at all; the options are in `OPTIONS`."""
    path = Path(path)
    check(path, **options)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        FORMATS[path.suffix.lower()](temporary, films, **options)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def iframe(films: Sequence[Film], *, height: int = 760) -> str:
    """The page inside of HTML, for notebooks: `IPython.display.HTML(iframe(films))`; `height` in pixels."""
    style = "width: 100%; max-width: 1000px; border: 0"
    return f'<div><iframe srcdoc="{html.escape(page.html(films))}" height="{height}" style="{style}"></iframe></div>'


def describe(task: Any) -> str:
    """The task and the size of its swarm, for titles."""
    return f"{type(task).__name__.lower()} of {task.num_agents} agents"


def of_seed(params: Any, index: int) -> Any:
    """The parameters of one of the seeds that were trained side by side."""
    return jax.tree.map(lambda leaf: leaf[index], params)


def write_replay(run_dir: Path, experiment: Any, params: Any, *, update: int, name: str = "replay.html") -> Path | None:
    """An episode of a policy as a page in the run folder; `None` after a warning, as no training is to fail by it."""
    try:
        title = f"{describe(experiment.task)}, after update {update}"
        write(run_dir / name, [record(experiment.task, experiment.network, params, title=title)])
    except Exception as error:
        print(f"warning: no {name}: {type(error).__name__}: {error}", file=sys.stderr)
        return None
    return run_dir / name


def hook(run_dir: Path, experiment: Any, render_every: int) -> Callable[[int, Any], None]:
    """What `fit` calls at evaluations; of each `render_every`-th it writes a replay of the first seed's policy.

    The first evaluation, of the untrained policy, is one of these. The files are `replay-<update>.html`.
    """

    def on_evaluation(update: int, params: Any) -> None:
        if update // experiment.eval_every % render_every == 0:
            write_replay(run_dir, experiment, of_seed(params, 0), update=update, name=f"replay-{update}.html")

    return on_evaluation
