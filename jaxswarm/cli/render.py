"""The program `jaxswarm-render`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.cli.policies import load_policy, require_fit, which_checkpoint
from jaxswarm.cli.words import load, only, program, split, use_compile_cache, wants_help, whole
from jaxswarm.config import ConfigError

HELP = """\
jaxswarm-render PATH [PATH ...] [out=FILE] [checkpoint=best|last] [seed=N] [task.key=value] ...

Plays an episode of each run's policy, side by side, and writes it in the format of the suffix of `out`:
  .html  one page that needs no network: play, scrub, click an agent to see what it looks at (default: replay.html)
  .png   a strip of frames=N pictures (6), evenly spaced up to step until=N (the end)
  .gif   a moving picture of frames=N pictures (150), up to step until=N
  .mp4   every step, up to step until=N; needs ffmpeg

examples
  jaxswarm-render runs/thesis
  jaxswarm-render runs/mean runs/bayesian seed=3 out=compared.html
  jaxswarm-render runs/thesis task.num_agents=200 out=strip.png frames=6 until=200
"""
OPTIONS = ("out", "checkpoint", "seed", "frames", "until")


@program
def main(arguments: Sequence[str]) -> int:
    """Plays policies and writes what was to be seen; returns the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    paths = [Path(word) for word in arguments if "=" not in word]
    options, words = split([word for word in arguments if "=" in word], OPTIONS)
    if not paths:
        raise ConfigError("give at least one run folder: jaxswarm-render PATH [key=value ...]")
    which, seed = which_checkpoint(options), whole("seed", options.get("seed", 0), 0)
    sizes = {name: whole(name, options[name], 1) for name in ("frames", "until") if name in options}
    pairs = configs.parse(words)
    only(pairs, lambda key: key.startswith("task."), "task.<field>=value")
    out = Path(options.get("out", paths[0] / "replay.html"))
    use_compile_cache()
    from jaxswarm import render  # noqa: PLC0415

    try:
        render.check(out, **sizes)
        films = [_film(path, pairs, which, seed) for path in paths]
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


def _film(run_dir: Path, pairs: Sequence[tuple[str, Any]], which: str, seed: int) -> Any:
    """An episode of the policy of a run; `None` if it cannot be restored."""
    config = configs.override(load(run_dir), pairs)
    task = configs.build_part("task", config)
    policy = load_policy(run_dir, load(run_dir), which)
    if policy is None:
        return None
    require_fit(policy, task)
    from jaxswarm import render  # noqa: PLC0415

    title = f"{run_dir.name}, {render.describe(task)}, after update {policy.update}"
    return render.record(task, policy.network, policy.params, seed=seed, title=title)
