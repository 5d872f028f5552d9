"""The program `jaxswarm-render`."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.cli.policy_options import policy_on_task
from jaxswarm.cli.program import (
    load_config,
    parse_integer,
    program,
    require_task_keys,
    split_paths,
    use_compile_cache,
    wants_help,
)
from jaxswarm.config import ConfigError
from jaxswarm.files import size_text

HELP = """\
jaxswarm-render PATH... [key=value ...] [task.KEY=VALUE ...]

Records one episode of the policy of each run and writes the episodes next to each other into one file. The suffix of
the file determines its format:
  .html  An offline page with playback. Click an agent to see what it perceives.
  .png   A strip of evenly spaced frames.
  .gif   An animation of evenly spaced frames.
  .mp4   A video of every step. It needs ffmpeg.

options
  PATH...          One or more run folders. Required.
  out=FILE         Path of the file, default: replay.html in the first PATH, or replay-2.html, ... if it exists.
  checkpoint=NAME  Checkpoint: best or last, default: best. The best one has the highest mean return over the seeds.
  seed=N           Seed of the episode. Integer >= 0, default: 0.
  train_seed=N     Seed of the run whose policy is shown. Integer, default: the first seed.
  frames=N         Number of frames of .png and .gif. Integer >= 1, default: 6 for .png, 150 for .gif.
  until=N          Last step of .png, .gif and .mp4. Integer >= 1, default: the end of the episode.
  task.KEY=VALUE   Change a field of the task. The type is that of the field, default: the task of the run.

examples
  jaxswarm-render runs/thesis
  jaxswarm-render runs/mean runs/bayesian seed=3 out=compared.html
  jaxswarm-render runs/thesis task.num_agents=200 out=strip.png frames=6 until=200
"""
OPTIONS = ("out", "checkpoint", "seed", "train_seed", "frames", "until")


@program
def main(arguments: Sequence[str]) -> int:
    """Record episodes of policies and write them to a file; return the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    paths, options, overrides = split_paths(arguments, OPTIONS)
    if not paths:
        raise ConfigError("give at least one run folder: jaxswarm-render PATH... [key=value ...]")
    seed = parse_integer("seed", options.get("seed", 0), 0)
    sizes = {name: parse_integer(name, options[name], 1) for name in ("frames", "until") if name in options}
    pairs = configs.parse(overrides)
    require_task_keys(pairs, load_config(paths[0]), OPTIONS)
    out = Path(options["out"]) if "out" in options else _vacant(paths[0] / "replay.html")
    is_replaced = out.exists()
    use_compile_cache()
    from jaxswarm import render  # noqa: PLC0415

    try:
        render.check(out, **sizes)
        films = [_film(path, pairs, options, seed, len(paths)) for path in paths]
        if None in films:
            return 1
        render.write(out, films, **sizes)
    except (ValueError, render.RenderError) as error:
        raise ConfigError(str(error)) from error
    except OSError as error:
        raise ConfigError(f"out: cannot write to {out}: {error.strerror}") from error
    for film in films:
        print(f"{film.title}: {film.num_frames - 1} steps, return {film.score[-1]:.2f}")
    print(f"{'replaced' if is_replaced else 'wrote'} {out} ({size_text(out)})")
    return 0


def _vacant(path: Path) -> Path:
    """Return the path, with a number appended to the name if the file exists."""
    numbered = (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))
    return next(one for one in itertools.chain([path], numbered) if not one.exists())


def _film(
    run_dir: Path, pairs: Sequence[tuple[str, Any]], options: Mapping[str, str], seed: int, num_films: int
) -> Any:
    """Record an episode of the policy of a run; return `None` if it cannot be restored.

    All `num_films` films together have at most `render.MAX_SHARES` weights.
    """
    found = policy_on_task(run_dir, pairs, options)
    if found is None:
        return None
    from jaxswarm import render  # noqa: PLC0415

    task, network, params, update = found
    title = f"{run_dir.name}, {render.describe(task)}, after update {update}"
    return render.record(task, network, params, seed=seed, title=title, max_shares=render.MAX_SHARES // num_films)
