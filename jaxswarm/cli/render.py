"""The program `jaxswarm-render`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.cli.policy_options import policy_on_task
from jaxswarm.cli.program import load, only_of_task, program, split_paths, use_compile_cache, wants_help, whole
from jaxswarm.config import ConfigError

HELP = """\
jaxswarm-render PATH [PATH ...] [out=FILE] [checkpoint=best|last] [seed=N] [train_seed=N] [task.key=value] ...

Plays an episode of each run's policy, side by side, and writes it in the format of the suffix of `out`. `seed` is that
of the episode; of a run with several seeds it is the policy of the first, or of train_seed.
  .html  one page that needs no network: play, scrub, click an agent to see what it looks at (default: replay.html)
  .png   a strip of frames=N pictures (6), evenly spaced up to step until=N (the end)
  .gif   a moving picture of frames=N pictures (150), up to step until=N
  .mp4   every step, up to step until=N; needs ffmpeg

examples
  jaxswarm-render runs/thesis
  jaxswarm-render runs/mean runs/bayesian seed=3 out=compared.html
  jaxswarm-render runs/thesis task.num_agents=200 out=strip.png frames=6 until=200
"""
OPTIONS = ("out", "checkpoint", "seed", "train_seed", "frames", "until")


@program
def main(arguments: Sequence[str]) -> int:
    """Plays policies and writes what was to be seen; returns the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    paths, options, overrides = split_paths(arguments, OPTIONS)
    if not paths:
        raise ConfigError("give at least one run folder: jaxswarm-render PATH [key=value ...]")
    seed = whole("seed", options.get("seed", 0), 0)
    sizes = {name: whole(name, options[name], 1) for name in ("frames", "until") if name in options}
    pairs = configs.parse(overrides)
    only_of_task(pairs, load(paths[0]), OPTIONS)
    out = Path(options.get("out", paths[0] / "replay.html"))
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
        raise ConfigError(f"cannot write {out}: {error.strerror}") from error
    for film in films:
        print(f"{film.title}: {film.num_frames - 1} steps, return {film.score[-1]:.2f}")
    print(f"wrote {out} ({out.stat().st_size / 1e6:.1f} MB)")
    return 0


def _film(
    run_dir: Path, pairs: Sequence[tuple[str, Any]], options: Mapping[str, str], seed: int, num_films: int
) -> Any:
    """An episode of the policy of a run; `None` if it cannot be restored. All films together stay below the limit."""
    found = policy_on_task(run_dir, pairs, options)
    if found is None:
        return None
    from jaxswarm import render  # noqa: PLC0415

    task, network, params, update = found
    title = f"{run_dir.name}, {render.describe(task)}, after update {update}"
    return render.record(task, network, params, seed=seed, title=title, max_shares=render.MAX_SHARES // num_films)
