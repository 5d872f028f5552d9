"""The programs `jaxswarm-train` and `jaxswarm-eval`."""

import functools
import gc
import json
import os
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.config import Config, ConfigError

TRAIN_HELP = """\
jaxswarm-train [group=choice | key=value] ... [run_dir=PATH]
jaxswarm-train resume=PATH [num_updates=N | total_agent_steps=N]

Trains a swarm and writes a run folder: config.yaml, manifest.json, metrics.csv, curve.png, checkpoints.
Ctrl-C or SIGTERM ends it after a checkpoint; resume=PATH continues it exactly where its last checkpoint stands.

examples
  jaxswarm-train
  jaxswarm-train aggregator=bayesian learner.learning_rate=3e-4 task.num_agents=10 seed=3
  jaxswarm-train experiment=rendezvous_thesis run_dir=runs/thesis
  jaxswarm-train resume=runs/thesis num_updates=320
"""

EVAL_HELP = """\
jaxswarm-eval PATH [episodes=N] [seed=N] [checkpoint=best|last] [task.key=value[,value...]] ...

Evaluates the trained policy of a run folder, also on changed tasks: prints a table and writes JSON into the folder.
The action is the mean of the policy; each episode is played in a world of its own.

examples
  jaxswarm-eval runs/thesis
  jaxswarm-eval runs/thesis episodes=100 checkpoint=last task.num_agents=5,10,20,50,100,200
"""


def _program(main: Callable[[Sequence[str]], int]) -> Callable[[Sequence[str] | None], int]:
    """Turns what users can mend into one line on stderr: 2 for a wrong command, 1 for a run that failed."""

    @functools.wraps(main)
    def program(arguments: Sequence[str] | None = None) -> int:
        gc.set_threshold(200_000)  # importing and tracing make many objects and little garbage: a tenth of the start
        try:
            return main(sys.argv[1:] if arguments is None else arguments)
        except ConfigError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("aborted", file=sys.stderr)
            return 130

    return program


@_program
def train(arguments: Sequence[str]) -> int:
    """Trains, or continues a run; returns the exit code."""
    if _wants_help(arguments):
        print(TRAIN_HELP + "\n" + _keys_help())
        return 0
    paths, words = _split(arguments, ("run_dir", "resume"))
    if "resume" in paths:
        if "run_dir" in paths:
            raise ConfigError("give one of run_dir and resume")
        return _resume(Path(paths["resume"]), words)
    config = configs.compose(words)
    run_dir = Path(paths.get("run_dir") or _default_run_dir(config))
    if run_dir.exists() and (not run_dir.is_dir() or any(run_dir.iterdir())):
        hint = f"continue it with resume={run_dir}" if (run_dir / "config.yaml").exists() else "it is not a run"
        raise ConfigError(f"run_dir={run_dir} exists and is not empty; {hint}, or choose another folder")
    return _fit(config, run_dir, is_resumed=False)


@_program
def evaluate(arguments: Sequence[str]) -> int:
    """Evaluates the policy of a run; returns the exit code."""
    if _wants_help(arguments) or not arguments:
        print(EVAL_HELP)
        return 0 if arguments else 2
    paths = [word for word in arguments if "=" not in word]
    options, words = _split([word for word in arguments if "=" in word], ("checkpoint", "episodes", "seed"))
    if len(paths) != 1:
        raise ConfigError(f"give one run folder, not {len(paths)}: jaxswarm-eval PATH [key=value ...]")
    which = options.get("checkpoint", "best")
    if which not in ("best", "last"):
        raise ConfigError(f"checkpoint = {which!r} is not possible; accepted: best, last")
    config = _load(Path(paths[0]))
    episodes = _whole("episodes", options.get("episodes", config["eval_worlds"]), 1)
    seed = _whole("seed", options.get("seed", 0), 0)
    changes = configs.combinations(words)
    _only(changes[0], lambda key: key.startswith("task."), "task.<field>=value")
    asked = {"which": which, "seed": seed, "episodes": episodes}
    result = _evaluate(Path(paths[0]), config, changes, asked)
    return _report(Path(paths[0]), result) if result else 1


def _resume(run_dir: Path, words: Sequence[str]) -> int:
    config = _load(run_dir)
    pairs = configs.parse(words)
    _only(pairs, lambda key: key in configs.LENGTHS, " or ".join(f"{name}=N" for name in configs.LENGTHS))
    extended = configs.override(config, pairs)
    if pairs:
        per_update = configs.build(config).agent_steps_per_update
        before, after = (configs.run_settings(x).length(per_update) for x in (config, extended))
        if after < before:
            raise ConfigError(f"{pairs[0][0]} = {pairs[0][1]} is {after} updates; accepted: {before} updates or more")
    return _fit(extended, run_dir, is_resumed=True)


def _fit(config: Config, run_dir: Path, is_resumed: bool) -> int:
    run, experiment = configs.run_settings(config), configs.build(config)
    num_updates = run.length(experiment.agent_steps_per_update)
    _use_compile_cache()
    from jaxswarm.checkpoint import CheckpointError, replace_text  # noqa: PLC0415
    from jaxswarm.fit import DivergedError, fit  # noqa: PLC0415

    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        replace_text(run_dir / "config.yaml", configs.dump(config))
    except OSError as error:
        raise ConfigError(f"cannot write to {run_dir}: {error.strerror}") from error
    print(_summary(config, experiment, num_updates, run_dir), flush=True)
    try:
        train_state, rows = fit(
            experiment,
            num_updates,
            seed=run.seed,
            run_dir=run_dir,
            resume=is_resumed,
            checkpoint_seconds=run.checkpoint_seconds,
            keep_checkpoints=run.keep_checkpoints,
        )
    except (DivergedError, CheckpointError) as error:
        print(f"error: {error}\n{_files(run_dir)}", file=sys.stderr)
        return 1
    update = int(train_state.update)
    if update < num_updates:
        print(f"stopped after update {update} of {num_updates}; continue with: {_resume_command(run_dir)}")
        return 0
    if rows:
        print(f"done: {update} updates, return {rows[-1]['eval/return']:.2f} (untrained {rows[0]['eval/return']:.2f})")
    print(f"{_files(run_dir)}\nnext: {_command('jaxswarm-eval', str(run_dir), 'episodes=100')}")
    return 0


def _evaluate(
    run_dir: Path, config: Config, changes: Sequence[Sequence[tuple[str, Any]]], asked: dict[str, Any]
) -> dict[str, Any] | None:
    """Plays the episodes of every changed task; `None` after saying that no checkpoint can be restored."""
    experiment = configs.build(config)
    tasks = [configs.override(config, pairs)["task"] for pairs in changes]
    built = [configs.build_part("task", {"task": task}) for task in tasks]
    _use_compile_cache()
    import jax  # noqa: PLC0415

    from jaxswarm import rollout  # noqa: PLC0415
    from jaxswarm.checkpoint import CheckpointError, restore  # noqa: PLC0415
    from jaxswarm.fit import abstract_state  # noqa: PLC0415

    warn = functools.partial(print, file=sys.stderr)
    try:
        restored = restore(run_dir / "checkpoints", abstract_state(experiment), asked["which"], warn)
    except CheckpointError as error:
        warn(f"error: {error}")
        return None
    if restored is None:
        raise ConfigError(f"{run_dir} has no checkpoint yet; continue it with: {_resume_command(run_dir)}")
    params, key = restored.train_state.learner.params, jax.random.key(asked["seed"])
    for task in built:
        needed = jax.eval_shape(lambda task=task: experiment.network.init(key, task.observe(task.reset(key))))
        if jax.tree.map(lambda x: x.shape, needed) != jax.tree.map(lambda x: x.shape, params):
            raise ConfigError("the policy cannot be used on this task: it was trained with observations of other sizes")

    @jax.jit
    def play(params: Any, task: Any) -> dict[str, Any]:
        policy: Any = functools.partial(experiment.network.apply, params, method="policy")
        return rollout.evaluate(key, task, policy, asked["episodes"])

    results = [
        {"changed": dict(pairs), "task": task, "metrics": {name: float(x) for name, x in play(params, b).items()}}
        for pairs, task, b in zip(changes, tasks, built, strict=True)
    ]
    found = {"update": restored.update, "score_in_training": restored.score, "device": jax.devices()[0].device_kind}
    return asked | found | {"results": results}


def _report(run_dir: Path, result: dict[str, Any]) -> int:
    from jaxswarm.checkpoint import replace_text  # noqa: PLC0415

    name = f"eval-{result['which']}-{time.strftime('%Y%m%d-%H%M%S')}"
    while (path := run_dir / f"{name}.json").exists():
        name += "x"
    replace_text(path, json.dumps(result, indent=2) + "\n")
    print(f"{run_dir}: {result['which']} checkpoint, of update {result['update']}; {result['episodes']} episodes")
    print(_table(result["results"]))
    print(f"wrote {path}")
    return 0


def _table(results: Sequence[dict[str, Any]]) -> str:
    """A row per metric, returns first; a column per changed task."""
    metrics = sorted(results[0]["metrics"], key=lambda name: not name.startswith("return"))
    rows = [[key, *[str(result["changed"][key]) for result in results]] for key in results[0]["changed"]]
    rows += [[name, *[f"{result['metrics'][name]:.4f}" for result in results]] for name in metrics]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    cells = [[x.rjust(width) for x, width in zip(row, widths, strict=True)] for row in rows]
    return "\n".join("  ".join(["", row[0].ljust(widths[0]), *line[1:]]) for row, line in zip(rows, cells, strict=True))


def _wants_help(arguments: Sequence[str]) -> bool:
    return any(word in ("-h", "--help", "help") for word in arguments)


def _keys_help() -> str:
    """Groups with the first comment of each file, and the other keys as the main file documents them."""
    lines = ["groups (* default)"]
    main = (configs.config_dir() / "train.yaml").read_text()
    for group, names in configs.choices().items():
        for name in names:
            text = (configs.config_dir() / group / f"{name}.yaml").read_text()
            comments = (line[2:] for line in text.splitlines() if line.startswith("# ") and not line.startswith("# @"))
            mark = "*" if f"- {group}: {name}\n" in main else " "
            lines.append(f"  {mark} {f'{group}={name}':<30} {next(comments, '')}")
    keys = main[main.index("_self_") :].split("\n", 2)[2].strip().splitlines()
    lines += ["", "keys (and those of each group, as task.num_agents=50)"]
    return "\n".join(lines + [f"  {line}" for line in keys])


def _split(arguments: Sequence[str], names: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """The program's own options, taken as they are written, and the other words."""
    options, words = {}, []
    for word in arguments:
        name, equals, value = word.partition("=")
        if equals and name in names:
            if not value:
                raise ConfigError(f"{name} has no value")
            options[name] = value
        else:
            words.append(word)
    return options, words


def _only(pairs: Sequence[tuple[str, Any]], is_accepted: Callable[[str], bool], accepted: str) -> None:
    for key, _ in pairs:
        if not is_accepted(key):
            raise ConfigError(f"{key} cannot be changed here; accepted: {accepted}")


def _whole(name: str, value: Any, least: int) -> int:
    try:
        number = int(value)
    except ValueError:
        number = least - 1
    if not least <= number < 2**32:
        raise ConfigError(f"{name} = {value} is not possible; accepted: integers from {least}")
    return number


def _load(run_dir: Path) -> Config:
    if not (run_dir / "config.yaml").is_file():
        raise ConfigError(f"{run_dir} is not a run folder: it has no config.yaml")
    return configs.load(run_dir / "config.yaml")


def _default_run_dir(config: Config) -> str:
    names = "-".join(config[part]["name"] for part in ("task", "aggregator", "learner"))
    path = base = f"runs/{names}-{time.strftime('%Y%m%d-%H%M%S')}"
    number = 2
    while Path(path).exists():
        path, number = f"{base}-{number}", number + 1
    return path


def _use_compile_cache() -> None:
    """Lets later starts find what was compiled before; has to come before anything is compiled."""
    import jax  # noqa: PLC0415

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "jaxswarm" / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _summary(config: Config, experiment: Any, num_updates: int, run_dir: Path) -> str:
    names = ", ".join(config[part]["name"] for part in ("task", "aggregator", "learner"))
    per_update = experiment.agent_steps_per_update
    return (
        f"{names}: {experiment.task.num_agents} agents, {num_updates} updates of {per_update:,} agent steps "
        f"({num_updates * per_update:,} in all), seed {config['seed']}\nrun folder: {run_dir}"
    )


def _resume_command(run_dir: Path) -> str:
    return _command("jaxswarm-train", f"resume={run_dir}")


def _command(program: str, *words: str) -> str:
    """What to type; with the folder of the program if it was called that way, from an environment not activated."""
    folder = Path(sys.argv[0]).parent
    if shutil.which(program) is None and (folder / program).exists():
        program = str(folder / program)
    return shlex.join([program, *words])


def _files(run_dir: Path) -> str:
    about = {
        "curve.png": "learning curve",
        "metrics.csv": "a row per evaluation",
        "checkpoints": "the latest and the best state",
        "config.yaml": "what was asked for",
        "manifest.json": "versions, device, exact numbers of steps",
    }
    return "\n".join(f"  {run_dir / name!s:<50} {text}" for name, text in about.items() if (run_dir / name).exists())
