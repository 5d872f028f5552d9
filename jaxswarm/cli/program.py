"""What the programs of the command line have in common: words in, exit codes and one line for every mistake out."""

import functools
import gc
import importlib.metadata
import os
import shlex
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.config import Config, ConfigError, schema


def program(main: Callable[[Sequence[str]], int]) -> Callable[[Sequence[str] | None], int]:
    """Turns what users can mend into one line on stderr: 2 for a wrong command, 1 for a run that failed.

    Every program also says which version it is.
    """

    @functools.wraps(main)
    def program(arguments: Sequence[str] | None = None) -> int:
        gc.set_threshold(200_000)  # importing and tracing make many objects and little garbage: a tenth of the start
        try:
            arguments = sys.argv[1:] if arguments is None else arguments
            code = _tell_version() if list(arguments) == ["--version"] else main(arguments)
            sys.stdout.flush()
            return code
        except ConfigError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("aborted", file=sys.stderr)
            return 130
        except BrokenPipeError:  # whoever read the output has gone, as after `| head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python flushes at its end
            return 141
        except OSError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
        except RuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            from jaxswarm.host.ensemble import LESS_MEMORY  # noqa: PLC0415

            print(f"error: out of memory; {LESS_MEMORY} ({str(error).splitlines()[0]})", file=sys.stderr)
            return 1

    return program


def _tell_version() -> int:
    print(f"jaxswarm {importlib.metadata.version('jaxswarm')}")
    return 0


def wants_help(arguments: Sequence[str]) -> bool:
    """Whether the user asks how to use the program."""
    return any(word in ("-h", "--help", "help") for word in arguments)


def split(arguments: Sequence[str], names: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """The program's own options, taken as they are written, and the other words."""
    options, overrides = {}, []
    for word in arguments:
        name, equals, value = word.partition("=")
        if equals and name in names:
            if not value:
                raise ConfigError(f"{name} has no value")
            options[name] = os.path.expanduser(value)  # which not every shell does behind a =
        else:
            overrides.append(word)
    return options, overrides


def split_paths(arguments: Sequence[str], names: Sequence[str]) -> tuple[list[Path], dict[str, str], list[str]]:
    """The words without a =, or that exist, which are paths; and `split` of the others."""
    paths = [word for word in arguments if "=" not in word or Path(word).exists()]
    return [Path(word) for word in paths], *split([word for word in arguments if word not in paths], names)


def only(
    pairs: Sequence[tuple[str, Any]], is_accepted: Callable[[str], bool], accepted: str, options: Sequence[str] = ()
) -> None:
    """Raises a `ConfigError` for the first key that is not accepted; one of the program's options may be meant."""
    for key, _ in pairs:
        if not is_accepted(key):
            near = schema.nearest(key, list(options))
            raise ConfigError(f"{key} cannot be changed here{near}; valid here: {accepted}")


def only_of_task(pairs: Sequence[tuple[str, Any]], config: Config, options: Sequence[str]) -> None:
    """Raises a `ConfigError` for the first key that is none of the task's."""
    keys = [f"{name}=..." for name in options]
    accepted = ", ".join(["task.<field>=value", *keys])
    meant = [*options, *config["task"], *(f"task.{name}" for name in config["task"])]
    only(pairs, lambda key: configs.full_key(key, config).startswith("task."), accepted, meant)


def whole(name: str, value: Any, least: int) -> int:
    """The value as an integer from `least`; a `ConfigError` for anything else."""
    try:
        number = int(value)
    except ValueError:
        number = least - 1
    if not least <= number < 2**32:
        raise ConfigError(f"{name}: must be an integer >= {least}, got {value!r}")
    return number


def load(run_dir: Path) -> Config:
    """The config of a run folder."""
    if not (run_dir / "config.yaml").is_file():
        raise ConfigError(f"{run_dir} is not a run folder: it has no config.yaml")
    return configs.load(run_dir / "config.yaml")


def use_compile_cache() -> None:
    """Lets later starts find what was compiled before; has to come before anything is compiled."""
    import jax  # noqa: PLC0415

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "jaxswarm" / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def join_processes() -> bool:
    """Joins the other processes of this training, if there are any; whether this is the one that writes and talks.

    Each of them runs the same command, with JAX_COORDINATOR_ADDRESS=HOST:PORT, JAX_NUM_PROCESSES and JAX_PROCESS_ID.
    """
    if "JAX_COORDINATOR_ADDRESS" not in os.environ:
        return True
    import jax  # noqa: PLC0415

    number, index = (
        whole(name, os.environ[name], least) if name in os.environ else None
        for name, least in (("JAX_NUM_PROCESSES", 1), ("JAX_PROCESS_ID", 0))
    )
    jax.config.update("jax_cpu_enable_async_dispatch", False)  # processes have to communicate in the same order
    try:
        jax.distributed.initialize(num_processes=number, process_id=index)
    except ValueError as error:  # numbers that are neither given nor known from a cluster
        raise ConfigError(f"JAX_COORDINATOR_ADDRESS needs JAX_NUM_PROCESSES and JAX_PROCESS_ID: {error}") from error
    return jax.process_index() == 0


def resume_command(run_dir: Path) -> str:
    """What to type to continue a run."""
    return command("jaxswarm-train", f"resume={run_dir}")


def command(program: str, *overrides: str) -> str:
    """What to type; with the folder of the program if it was called that way, from an environment not activated."""
    folder = Path(sys.argv[0]).parent
    if shutil.which(program) is None and (folder / program).exists():
        program = str(folder / program)
    return shlex.join([program, *overrides])
