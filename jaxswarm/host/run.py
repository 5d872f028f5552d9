"""One training run: an experiment, its settings and its folder; and whether it may be trained into that folder."""

import contextlib
import dataclasses
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxswarm import config as configs
from jaxswarm import files
from jaxswarm.config import Config, ConfigError, RunSettings
from jaxswarm.host.checkpoint import read_records
from jaxswarm.training import Experiment

# Keys that may differ between the config of a run folder and the run that resumes it.
MAY_CHANGE = {*configs.LENGTHS, "checkpoint_seconds", "keep_checkpoints", "render_every", "loggers", "imports"}


@dataclasses.dataclass(frozen=True)
class Run:
    """An experiment with the settings that it is trained with, and the folder that it is written into.

    Attributes:
        experiment: What is trained.
        settings: Seeds, length, checkpoints, loggers and the warm start.
        run_dir: Run folder; `None` writes no files.
        config: Config that is stored in the folder and passed to loggers; `None` if no config describes the run.
        on_evaluation: Called at each evaluation but the last with the number of updates done and the parameters of
            the evaluated policies, [seeds, ...].
        init_params: Network parameters that all seeds start from; `None`: `settings.init_from` decides.
    """

    experiment: Experiment
    settings: RunSettings
    run_dir: Path | None = None
    config: Mapping[str, Any] | None = None
    on_evaluation: Callable[[int, Any], None] | None = None
    init_params: Any = None

    @classmethod
    def from_config(cls, config: Config, run_dir: Path) -> "Run":
        """Build the run that a complete config describes; raises a `ConfigError` for impossible values."""
        return cls(configs.build(config), configs.run_settings(config), run_dir, config)

    @property
    def folder(self) -> Path:
        """Run folder of a run that has one."""
        assert self.run_dir is not None
        return self.run_dir

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds that are trained in one program."""
        return self.settings.seeds

    @property
    def num_updates(self) -> int:
        """Length of the run in updates."""
        return self.settings.length(self.experiment.agent_steps_per_update)

    @property
    def num_evaluations(self) -> int:
        """Number of evaluations, including the one of the final policy."""
        return math.ceil(self.num_updates / self.experiment.eval_every) + 1


@contextlib.contextmanager
def locked(run_dir: Path) -> Iterator[None]:
    """Hold the folder's lock, so that no other process trains into it; a `ConfigError` if another process holds it.

    Creates the folder, and removes it at the end if it is empty. The system releases the lock when the process ends.
    Without support for file locks, nothing is locked.
    """
    with contextlib.ExitStack() as stack:
        try:
            while not _lock(run_dir, stack):
                pass
        except BlockingIOError:
            raise ConfigError(f"{run_dir} is being trained by another process; wait for it, or stop it") from None
        with files.removed_if_empty(run_dir):
            yield


def _lock(run_dir: Path, stack: contextlib.ExitStack) -> bool:
    """Create and lock the folder until the stack is closed; return whether the locked folder still exists.

    Another process, which held the lock before, may remove its empty folder. Raises a `BlockingIOError` if another
    process holds the lock.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    try:
        import fcntl  # noqa: PLC0415

        descriptor = os.open(run_dir, os.O_RDONLY)
        stack.callback(os.close, descriptor)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(descriptor), os.stat(run_dir))
    except (BlockingIOError, PermissionError):
        raise
    except FileNotFoundError:
        return False
    except (ImportError, OSError):
        return True


def load_config(run_dir: Path) -> Config:
    """Load the validated config of a run folder and run its imports.

    A config file that is missing or damaged is replaced by the config in the newest checkpoint, after one line of
    warning. Raises a `ConfigError` if there is none either.
    """
    path = run_dir / "config.yaml"
    try:
        content = _read_config(path)
    except ConfigError as error:
        stored = _stored_config(run_dir)
        if stored is None:
            text = str(error) if path.exists() else f"{run_dir} is not a run folder: it has no config.yaml"
            raise ConfigError(text) from None
        print(f"warning: {path} is missing or damaged; its content is taken from a checkpoint", file=sys.stderr)
        content = stored
    return configs.activate(content, run_dir)


def _read_config(path: Path) -> Config:
    content = configs.read(path)
    if not all(isinstance(content.get(part), dict) for part in configs.PARTS):
        raise ConfigError(f"cannot read {path}: it has not all of {', '.join(configs.PARTS)}")
    return content


def _stored_config(run_dir: Path) -> Config | None:
    records = read_records(run_dir / "checkpoints").values()
    found = [identity["config"] for record in records if (identity := record.get("identity"))]
    return found[-1] if found else None


def has_checkpoint(run_dir: Path) -> bool:
    """Return whether the folder holds a checkpoint, damaged or not."""
    return any(run_dir.glob("checkpoints/[0-9]*"))


def split_started(run_dirs: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Split run folders into those to resume together, and new ones beside folders that have checkpoints."""
    without_checkpoint = [path for path in run_dirs if not has_checkpoint(path)]
    is_empty = {path: path in without_checkpoint and not _has_rows(path) for path in run_dirs}
    new = [path for path in run_dirs if is_empty[path] and len(without_checkpoint) < len(run_dirs)]
    return [path for path in run_dirs if path not in new], new


def _has_rows(run_dir: Path) -> bool:
    return (run_dir / "metrics.csv").exists() and (run_dir / "metrics.csv").stat().st_size > 0


def check_folder(run: Run, resume: bool, force: bool = False) -> None:
    """Raise a `FileExistsError` if training would replace results in the run's folder or mix them with another run.

    With `force`, the settings may differ.
    """
    if run.run_dir is None:
        return
    if any(character in str(run.run_dir.resolve()) for character in "[]\\"):
        raise ConfigError(f"run_dir: must not contain [, ] or \\, which checkpoints do not support, got {run.run_dir}")
    if not resume:
        if (run.run_dir / "metrics.csv").exists():
            raise FileExistsError(f"{run.run_dir} already holds a run; resume it or choose another folder")
        return
    rows = [] if run.config is not None and has_checkpoint(run.run_dir) else _rows(run.run_dir)
    if rows and not (run.run_dir / "checkpoints").exists():
        raise FileExistsError(
            f"{run.run_dir} holds evaluations but no checkpoints, so it cannot be resumed; "
            "choose another folder to train it again"
        )
    seeds = sorted({int(row["seed"]) for row in rows if "seed" in row})
    changed = _changes(run) if set(seeds) <= set(run.seeds) else {"seeds": (seeds, list(run.seeds))}
    if changed and not force:
        name, (before, now) = next(iter(changed.items()))
        raise FileExistsError(f"{run.run_dir} holds another run: {name} is {before} there, and {now} here")


def _rows(run_dir: Path) -> list[files.Row]:
    try:
        return read_rows(run_dir)
    except ConfigError:
        if has_checkpoint(run_dir):  # which may restore the rows
            return []
        raise


def read_rows(run_dir: Path) -> list[files.Row]:
    """Return the rows of a run's `metrics.csv`; raises a `ConfigError` if the file is damaged."""
    try:
        return files.read_rows(run_dir / "metrics.csv")
    except (ValueError, KeyError) as error:
        raise ConfigError(f"cannot read {run_dir / 'metrics.csv'}: {error}") from error


def _changes(run: Run) -> dict[str, tuple]:
    """Return the config keys that resuming must not change, with their values in the folder and in the run."""
    if run.config is None:
        return {}
    try:
        return changed_settings(_read_config(run.folder / "config.yaml"), run.config)
    except ConfigError:  # it is missing or damaged; checkpoints store it, too
        return {}


def changed_settings(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple]:
    """Return the keys that resuming must not change, with their values in both configs, if these differ."""
    with contextlib.suppress(ConfigError):  # a config of another version is compared as it is
        before = configs.validate(dict(before))
    one, other = (configs.flat(config) for config in (before, now))
    names = [name for name in other if name not in MAY_CHANGE and one.get(name) != other[name]]
    return {name: (one.get(name), other[name]) for name in names}
