"""The program `jaxswarm-export`."""

from collections.abc import Sequence
from pathlib import Path

from jaxswarm import config as configs
from jaxswarm.cli.policy_options import policy_on_task
from jaxswarm.cli.program import load_config, program, require_task_keys, split_paths, use_compile_cache, wants_help
from jaxswarm.config import ConfigError

HELP = """\
jaxswarm-export PATH [key=value ...] [task.KEY=VALUE ...]

Writes the policy of a run folder to one file. The file contains a program from observations to means and standard
deviations of the actions, with the parameters. It runs wherever JAX runs, and jaxswarm need not be installed. The
program takes any number of agents, also a single robot. It has slots for everything that an agent of the task can
perceive, and unneeded slots are masked. Use the mean as the action, clipped to [-1, 1] as in the tasks.

options
  PATH             Run folder. Required.
  out=FILE         Path of the file, which ends in .jax, default: PATH/policy.jax.
  checkpoint=NAME  Checkpoint: best or last, default: best. The best one has the highest mean return over the seeds.
  train_seed=N     Seed of the run whose policy is exported. Integer, default: the first seed.
  task.KEY=VALUE   Change a field of the task, which determines the number of slots. The type is that of the field,
                   default: the task of the run.

examples
  jaxswarm-export runs/thesis
  jaxswarm-export runs/thesis task.num_agents=100 out=policy.jax     # up to 99 neighbors
"""
USE = """\
use it with the packages jax and flatbuffers:
  from jax import export
  policy = export.deserialize(open("{path}", "rb").read())
  mean, std = policy.call(own, groups)
own is {own}, groups is {groups}: (features, mask) of each group\
"""
SUFFIX = ".jax"  # of the file
OPTIONS = ("out", "checkpoint", "train_seed")


@program
def main(arguments: Sequence[str]) -> int:
    """Export the policy of a run; return the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    paths, options, overrides = split_paths(arguments, OPTIONS)
    if len(paths) != 1:
        raise ConfigError(f"give one run folder, got {len(paths)}: jaxswarm-export PATH [key=value ...]")
    pairs = configs.parse(overrides)
    require_task_keys(pairs, load_config(paths[0]), OPTIONS)
    out = Path(options.get("out", paths[0] / "policy.jax"))
    if out.suffix not in ("", SUFFIX):
        raise ConfigError(f"out: must end in {SUFFIX}, got {str(out)!r}")
    if out.is_dir():
        raise ConfigError(f"out: must be a file, got the folder {str(out)!r}")
    use_compile_cache()
    found = policy_on_task(paths[0], pairs, options)
    if found is None:
        return 1
    import jax  # noqa: PLC0415

    from jaxswarm import export, files  # noqa: PLC0415

    task, network, params, update = found
    exported = export.export_policy(task, network, params)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        files.replace_bytes(out, bytes(exported.serialize()))
    except OSError as error:
        raise ConfigError(f"out: cannot write to {out}: {error.strerror}") from error
    print(f"wrote {out} ({files.size_text(out)}), the policy after update {update}")
    own, groups = jax.tree.unflatten(exported.in_tree, map(str, exported.in_avals))[0]
    print(USE.format(path=out, own=own, groups=str(groups).replace("'", "")))
    return 0
