"""Loggers that send evaluations to TensorBoard and Weights & Biases. Each needs an extra of this package.

`LOGGERS[name](run_dir, config, seed)` opens the logger of one seed. `log(row)` logs the rows of `metrics.csv` in order,
over agent steps and without NaN values. `close()` returns when everything is written. Opening a logger raises a
`ConfigError` that names the extra if its package is missing.
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

AXES = ("agent_steps", "seed")  # columns that are no metrics: the horizontal axis and the name of the stream


class Logger(Protocol):
    """Open logger of one seed."""

    def log(self, row: Row) -> None:
        """Log the numbers of an evaluation."""
        ...

    def close(self) -> None:
        """Wait until all rows are written, and close the logger."""
        ...


class TensorBoard:
    """Logger that writes event files to `run_dir/tensorboard/seed_<seed>`. A resumed run adds another file."""

    def __init__(self, run_dir: str | Path, config: Mapping[str, Any] | None, seed: int):
        package = import_package("tensorboard")
        self._writer = package.SummaryWriter(str(Path(run_dir) / "tensorboard" / f"seed_{seed}"))
        if config is not None:
            self._writer.add_text("config", "\n".join(f"    {line}" for line in _lines(config)))

    def log(self, row: Row) -> None:
        """Log each number as a scalar at the agent steps of the row."""
        for name, value in _numbers(row).items():
            self._writer.add_scalar(name, value, global_step=row["agent_steps"])
        self._writer.flush()

    def close(self) -> None:
        """Close the event file."""
        self._writer.close()


class WeightsAndBiases:
    """Logger that writes to a Weights & Biases run in the project `jaxswarm`; the run folder is its group.

    Its files are in `run_dir/wandb`. A resumed run resumes the same W&B run. Environment variables `WANDB_...` set
    project, account and other options; `WANDB_MODE=offline` logs without network.
    """

    def __init__(self, run_dir: str | Path, config: Mapping[str, Any] | None, seed: int):
        package, run_dir = import_package("wandb"), Path(run_dir).resolve()
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
        """Log the numbers together with the agent steps, their horizontal axis."""
        self._run.log({"agent_steps": row["agent_steps"], **_numbers(row)})

    def close(self) -> None:
        """Finish the W&B run; in online mode, this waits until everything is uploaded."""
        self._run.finish()


PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb"}

LOGGERS: dict[str, Callable[[str | Path, Mapping[str, Any] | None, int], Logger]] = {
    "tensorboard": TensorBoard,
    "wandb": WeightsAndBiases,
}


def import_package(name: str) -> ModuleType:
    """Import the package of a logger. Raise a `ConfigError` for an unknown logger or a missing package."""
    if name not in PACKAGES:
        raise ConfigError(f"loggers: must be a list of {', '.join(PACKAGES)}, got {name!r}")
    try:
        return importlib.import_module(PACKAGES[name])
    except ImportError as error:
        hint = f'install it with: pip install "jaxswarm[{name}]"'
        raise ConfigError(f"loggers: {name} needs the package {PACKAGES[name]}; {hint}") from error


def _numbers(row: Row) -> Row:
    return {name: x for name, x in row.items() if name not in AXES and not math.isnan(x)}


def _lines(config: Mapping[str, Any]) -> list[str]:
    from jaxswarm.config import dump  # noqa: PLC0415

    return dump(dict(config)).splitlines()
