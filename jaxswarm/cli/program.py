"""Shared parts of the command line programs: options and overrides, exit codes, one line for each user error."""

import contextlib
import errno
import functools
import gc
import importlib.metadata
import os
import shlex
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm.config import Config, ConfigError, plugins, schema

UNUSABLE_PATH = {
    *(errno.ENOENT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EEXIST, errno.ENOTDIR, errno.EISDIR),
    *(errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL),
}


def program(main: Callable[[Sequence[str]], int]) -> Callable[[Sequence[str] | None], int]:
    """Turn user errors into one line on stderr, with exit code 2 for a wrong command and 1 for a failed run.

    Every program also supports `--version`.
    """

    @functools.wraps(main)
    def program(arguments: Sequence[str] | None = None) -> int:
        # Imports and tracing make many objects and little garbage; this saves a tenth of the start-up time.
        gc.set_threshold(200_000)
        try:
            arguments = list(sys.argv[1:] if arguments is None else arguments)
            with _isolated(), plugins.trusting("trust=true" in arguments):
                arguments = [word for word in arguments if word not in ("trust=true", "trust=false")]
                code = _print_version() if arguments == ["--version"] else main(arguments)
            sys.stdout.flush()
            return code
        except KeyboardInterrupt:
            print("aborted", file=sys.stderr)
            return 130
        except BrokenPipeError:  # the reader of the output has closed it, as `| head` does
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the final flush of Python
            return 141
        except (ConfigError, OSError, RuntimeError, AssertionError) as error:
            code, reason = _explain(error)
            print(f"error: {reason}", file=sys.stderr)
            return code

    return program


def _explain(error: Exception) -> tuple[int, str]:
    """Return the exit code and the line for an error of the user or of the machine; raise any other error."""
    first_line = next(iter(str(error).splitlines()), "")
    if isinstance(error, ConfigError):
        return 2, str(error)
    if isinstance(error, OSError):
        path = schema.shown(str(error.filename)).strip("'")
        reason = f"{path}: {error.strerror}" if error.filename and error.strerror else str(error)
        return 2 if error.errno in UNUSABLE_PATH else 1, reason
    if "JAX_PLATFORMS" in os.environ and _is_of_backend(error):
        return 1, f"JAX_PLATFORMS: must name devices that can be used here, got {os.environ['JAX_PLATFORMS']!r}"
    if type(error).__module__.startswith("jaxswarm."):  # no seed or no checkpoint is left
        return 1, first_line
    if "RESOURCE_EXHAUSTED" not in str(error):
        raise error
    from jaxswarm.host.ensemble import LESS_MEMORY  # noqa: PLC0415

    return 1, f"out of memory; {LESS_MEMORY} ({first_line})"


def _is_of_backend(error: BaseException) -> bool:
    """Return whether JAX raised the error when it initialized its devices."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and Path(frames[-1].filename).name == "xla_bridge.py"


@contextlib.contextmanager
def _isolated() -> Iterator[None]:
    """Keep settings inherited from a notebook or a terminal from ending a program, and restore them after it."""
    inherited = {name: os.environ.get(name) for name in ("MPLBACKEND", "JAX_ENABLE_X64", "XLA_FLAGS")}
    os.environ["MPLBACKEND"] = "agg"
    os.environ.pop("JAX_ENABLE_X64", None)  # programs compute in single precision
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, ValueError):  # not a stream of the system
            stream.reconfigure(errors="replace")  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        for name, value in inherited.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _print_version() -> int:
    print(f"jaxswarm {importlib.metadata.version('jaxswarm')}")
    return 0


def wants_help(arguments: Sequence[str]) -> bool:
    """Return whether the arguments ask for help."""
    return any(argument in ("-h", "--help", "help") for argument in arguments)


def split(arguments: Sequence[str], names: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Split arguments into the program's own options, taken literally, and overrides."""
    options, overrides = {}, []
    for word in arguments:
        name, equals, value = word.partition("=")
        if equals and name in names:
            if not value:
                raise ConfigError(f"{name} has no value")
            options[name] = os.path.expanduser(value)  # many shells expand ~ only at the start of a word
        else:
            overrides.append(word)
    return options, overrides


def split_paths(arguments: Sequence[str], names: Sequence[str]) -> tuple[list[Path], dict[str, str], list[str]]:
    """Split arguments into paths (without "=", or existing), the program's own options, and overrides.

    `imports=...` runs these files in place of the imports that the run folders store.
    """
    paths = [word for word in arguments if "=" not in word or os.path.exists(word)]  # false for impossible names
    options, overrides = split([word for word in arguments if word not in paths], names)
    return [Path(word) for word in paths], options, substitute_imports(overrides)


def substitute_imports(overrides: Sequence[str]) -> list[str]:
    """Run the imports among the overrides in place of stored ones, and return the other overrides."""
    own = [word for word in overrides if word.startswith("imports=")]
    for _, value in configs.parse(own):
        plugins.substitute(value)
    return [word for word in overrides if word not in own]


def require_keys(
    pairs: Sequence[tuple[str, Any]], is_accepted: Callable[[str], bool], accepted: str, options: Sequence[str] = ()
) -> None:
    """Raise a `ConfigError` for the first key that is not accepted; it suggests the nearest option of the program."""
    for key, _ in pairs:
        if not is_accepted(key):
            near = schema.nearest(key, list(options))
            raise ConfigError(f"{key} cannot be changed here{near}; valid here: {accepted}")


def require_task_keys(pairs: Sequence[tuple[str, Any]], config: Config, options: Sequence[str]) -> None:
    """Raise a `ConfigError` for the first key that is not a key of the task."""
    for key, value in pairs:
        if key in configs.REGISTERED:
            name, task = config[key]["name"], config["task"]["name"]
            accepted = f"{name!r}, which the policy was trained with"
            raise ConfigError(f"{key}: must be {accepted}, got {value!r}; change fields of {task} with task.KEY=VALUE")
    keys = [f"{name}=..." for name in options]
    accepted = ", ".join(["task.<field>=value", *keys])
    meant = [*options, *config["task"], *(f"task.{name}" for name in config["task"])]
    require_keys(pairs, lambda key: configs.full_key(key, config).startswith("task."), accepted, meant)


def warn(text: str) -> None:
    """Print a line on stderr."""
    print(text, file=sys.stderr)


def parse_integer(name: str, value: Any, least: int) -> int:
    """Return the value as an integer >= `least`; raise a `ConfigError` for anything else."""
    try:
        number = int(value)
    except ValueError:
        number = least - 1
    if not least <= number < 2**32:
        raise ConfigError(f"{name}: must be an integer >= {least}, got {value!r}")
    return number


def parse_flag(name: str, value: str) -> bool:
    """Return the value of an option that is true or false; raise a `ConfigError` for anything else."""
    if value not in ("true", "false"):
        raise ConfigError(f"{name}: must be true or false, got {value!r}")
    return value == "true"


def load_config(run_dir: Path) -> Config:
    """Load the config of a run folder; raise a `ConfigError` if the folder is no run folder."""
    from jaxswarm.host import run  # noqa: PLC0415

    return run.load_config(run_dir)


def use_compile_cache() -> None:
    """Cache compiled programs on disk for later starts; must be called before anything is compiled.

    A user without a home directory, as in a container with a foreign user id, gets no cache.
    """
    import jax  # noqa: PLC0415

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        try:
            home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        except RuntimeError:
            return
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "jaxswarm" / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def join_processes() -> bool:
    """Join the other processes of this training, if any; return whether this process writes files and prints.

    Each process runs the same command, with JAX_COORDINATOR_ADDRESS=HOST:PORT, JAX_NUM_PROCESSES and JAX_PROCESS_ID.
    """
    if "JAX_COORDINATOR_ADDRESS" not in os.environ:
        return True
    import jax  # noqa: PLC0415

    number, index = (
        parse_integer(name, os.environ[name], least) if name in os.environ else None
        for name, least in (("JAX_NUM_PROCESSES", 1), ("JAX_PROCESS_ID", 0))
    )
    jax.config.update("jax_cpu_enable_async_dispatch", False)  # processes must communicate in the same order
    try:
        jax.distributed.initialize(num_processes=number, process_id=index)
    except ValueError as error:  # the numbers are neither given nor known from a cluster
        raise ConfigError(f"JAX_COORDINATOR_ADDRESS needs JAX_NUM_PROCESSES and JAX_PROCESS_ID: {error}") from error
    return jax.process_index() == 0


def resume_command(run_dir: Path) -> str:
    """Return the command that resumes a run."""
    return command("jaxswarm-train", f"resume={run_dir}")


def command(program: str, *overrides: str) -> str:
    """Return a shell command, with the program's folder if its environment is not activated."""
    folder = Path(sys.argv[0]).parent
    if shutil.which(program) is None and (folder / program).exists():
        program = str(folder / program)
    return shlex.join([program, *overrides])
