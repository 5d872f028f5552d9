"""The program `jaxswarm-export`."""

from collections.abc import Sequence
from pathlib import Path

from jaxswarm import config as configs
from jaxswarm.cli.policy_options import policy_on_task
from jaxswarm.cli.program import load, only_of_task, program, split_paths, use_compile_cache, wants_help
from jaxswarm.config import ConfigError

HELP = """\
jaxswarm-export PATH [out=FILE] [checkpoint=best|last] [train_seed=N] [task.key=value] ...

Writes the policy of a run folder as one file, PATH/policy.jax unless `out` names another: a program from observations
to means and standard deviations of actions, its parameters inside, that runs wherever JAX does, without jaxswarm. It
takes any number of agents at a time, be it one robot, and has slots for what agents of this task can perceive; those
not needed are masked. Act by the mean, clipped to [-1, 1] as the worlds do. Of a run with several seeds it is the
policy of the first, or of train_seed.

examples
  jaxswarm-export runs/thesis
  jaxswarm-export runs/thesis task.num_agents=100 out=policy.jax     # up to 99 neighbors
"""
USE = """\
with jax and flatbuffers:
  from jax import export
  policy = export.deserialize(open("{path}", "rb").read())
  mean, std = policy.call(own, groups)
own is {own}, groups {groups}: features and mask of each\
"""
OPTIONS = ("out", "checkpoint", "train_seed")


@program
def main(arguments: Sequence[str]) -> int:
    """Exports the policy of a run; returns the exit code."""
    if wants_help(arguments) or not arguments:
        print(HELP)
        return 0 if arguments else 2
    paths, options, overrides = split_paths(arguments, OPTIONS)
    if len(paths) != 1:
        raise ConfigError(f"give one run folder, not {len(paths)}: jaxswarm-export PATH [key=value ...]")
    pairs = configs.parse(overrides)
    only_of_task(pairs, load(paths[0]), OPTIONS)
    out = Path(options.get("out", paths[0] / "policy.jax"))
    use_compile_cache()
    found = policy_on_task(paths[0], pairs, options)
    if found is None:
        return 1
    import jax  # noqa: PLC0415

    from jaxswarm import export, files  # noqa: PLC0415

    task, network, params, update = found
    exported = export.export_policy(task, network, params)
    out.parent.mkdir(parents=True, exist_ok=True)
    files.replace_bytes(out, bytes(exported.serialize()))
    print(f"wrote {out} ({out.stat().st_size / 1e6:.2f} MB), the policy after update {update}")
    own, groups = jax.tree.unflatten(exported.in_tree, map(str, exported.in_avals))[0]
    print(USE.format(path=out, own=own, groups=str(groups).replace("'", "")))
    return 0
