"""Evaluations for the programs that others watch training with; each is an extra of this package.

A logger is opened as `LOGGERS[name](run_dir, config, seed)` and is one stream of events, that of this seed: `log(row)`
takes the rows of `metrics.csv` in order, with agent steps as the horizontal axis and without what is NaN; `close()`
returns when all is written. A `ConfigError` says which extra has to be installed.
"""

import importlib
import math
import os
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

from jaxswarm.config import ConfigError
from jaxswarm.files import Row

AXES = ("agent_steps", "seed")  # of a row, what is said otherwise


class Logger(Protocol):
    """What is done with an open logger."""

    def log(self, row: Row) -> None:
        """Adds an evaluation."""
        ...

    def close(self) -> None:
        """Returns when all is written."""
        ...


class TensorBoard:
    """Event files in `run_dir/tensorboard/seed_<seed>`; a resumed run adds a file of its own."""

    def __init__(self, run_dir: str | Path, config: Mapping[str, Any] | None, seed: int):
        package = load("tensorboard")
        self._writer = package.SummaryWriter(str(Path(run_dir) / "tensorboard" / f"seed_{seed}"))
        if config is not None:
            self._writer.add_text("config", "\n".join(f"    {line}" for line in _lines(config)))

    def log(self, row: Row) -> None:
        """Adds each number as a scalar at the agent steps of the row."""
        for name, value in _numbers(row).items():
            self._writer.add_scalar(name, value, global_step=row["agent_steps"])
        self._writer.flush()

    def close(self) -> None:
        """Closes the event file."""
        self._writer.close()


class WeightsAndBiases:
    """A run of the project `jaxswarm`, in the group of its run folder; offline where `WANDB_MODE=offline` says so.

    Its files are in `run_dir/wandb`; a resumed run goes on with the same one. Project, account and the like follow the
    variables `WANDB_...` of the environment.
    """

    def __init__(self, run_dir: str | Path, config: Mapping[str, Any] | None, seed: int):
        package, run_dir = load("wandb"), Path(run_dir).resolve()
        run_dir.mkdir(parents=True, exist_ok=True)
        id_file = run_dir / "wandb" / f"seed_{seed}.id"
        id_file.parent.mkdir(exist_ok=True)
        if not id_file.exists():
            id_file.write_text(uuid.uuid4().hex[:8])
        try:
            self._run = package.init(
                id=id_file.read_text(),
                resume="allow",
                project=os.environ.get("WANDB_PROJECT", "jaxswarm"),
                dir=run_dir,
                group=run_dir.name,
                name=f"{run_dir.name}-seed{seed}",
                config={**(config or {}), "seed": seed},
                reinit="create_new",
                settings=package.Settings(console="off", silent=True),
            )
        except package.Error as error:
            hint = "log in with `wandb login`, or set WANDB_MODE=offline"
            raise ConfigError(f"Weights & Biases cannot start: {' '.join(str(error).split())}; {hint}") from error
        self._run.define_metric("*", step_metric="agent_steps")

    def log(self, row: Row) -> None:
        """Adds the numbers, and the agent steps that they are shown over."""
        self._run.log({"agent_steps": row["agent_steps"], **_numbers(row)})

    def close(self) -> None:
        """Ends the run; online, when all is uploaded."""
        self._run.finish()


PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb"}

LOGGERS: dict[str, Callable[[str | Path, Mapping[str, Any] | None, int], Logger]] = {
    "tensorboard": TensorBoard,
    "wandb": WeightsAndBiases,
}


def load(name: str) -> ModuleType:
    """The package that a logger needs; a `ConfigError` says how to get it, or which loggers there are."""
    if name not in PACKAGES:
        raise ConfigError(f"loggers: must be a list of {', '.join(PACKAGES)}, got {name!r}")
    try:
        return importlib.import_module(PACKAGES[name])
    except ImportError as error:
        raise ConfigError(f'{name} needs a package: pip install "jaxswarm[{name}]"') from error


def _numbers(row: Row) -> Row:
    return {name: x for name, x in row.items() if name not in AXES and not math.isnan(x)}


def _lines(config: Mapping[str, Any]) -> list[str]:
    from jaxswarm.config import dump  # noqa: PLC0415

    return dump(dict(config)).splitlines()
