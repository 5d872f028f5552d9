"""What a run shows and leaves behind: a progress bar, `manifest.json`, `metrics.csv` and `curve.png`."""

import csv
import importlib.metadata
import importlib.util
import io
import json
import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxswarm import curves, plots
from jaxswarm.checkpoint import replace_text
from jaxswarm.learners.on_policy import OnPolicy, batch_size

RETURN = "eval/return"
Row = dict[str, Any]  # a line of metrics.csv; empty cells are NaN

PACKAGES = ("jaxswarm", "jax", "jaxlib", "flax", "optax", "distrax", "orbax-checkpoint", "numpy")
INTEGERS = ("update", "agent_steps", "seed")
LEADING = ("update", "agent_steps", "wall_seconds", "seed", "eval/return", "eval/return_std")
SECONDS_BETWEEN_LINES = 10.0  # where there is no terminal to draw a bar on


def manifest(experiment: Any, num_updates: int, seeds: Sequence[int]) -> dict[str, Any]:
    """Versions, device, revision and the exact arithmetic of steps."""
    per_update = experiment.agent_steps_per_update
    steps = {
        "updates": num_updates,
        "num_agents": experiment.task.num_agents,
        "num_worlds": experiment.num_worlds,
        "steps_per_world_and_update": experiment.num_steps,
        "environment_steps_per_update": experiment.num_worlds * experiment.num_steps,
        "agent_steps_per_update": per_update,
        "environment_steps": num_updates * experiment.num_worlds * experiment.num_steps,
        "agent_steps": num_updates * per_update,
        "evaluations": math.ceil(num_updates / experiment.eval_every) + 1,
        "episodes_per_evaluation": experiment.eval_worlds,
    }
    if isinstance(experiment.learner, OnPolicy):
        size = batch_size(experiment.learner, per_update, experiment.task.num_agents)
        gradient_steps = experiment.learner.num_epochs * per_update // size
        steps |= {
            "samples_per_gradient_step": size,
            "gradient_steps_per_update": gradient_steps,
            "gradient_steps": num_updates * gradient_steps,
        }
    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": sys.argv,
        "seeds": list(seeds),
        "steps": steps,
    } | provenance()


def provenance() -> dict[str, Any]:
    """What code ran on what machine."""
    device = jax.devices()[0]
    return {
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES},
        "platform": f"{platform.system()} {platform.machine()}",
        "device": {"backend": device.platform, "kind": device.device_kind, "count": jax.device_count()},
        "git_revision": _git_revision(),
    }


def write_manifest(path: Path, content: dict[str, Any]) -> None:
    """Writes the manifest; a resumed run adds its own beside those of the sessions before."""
    try:
        before = json.loads(path.read_text())
        content = content | {"earlier_sessions": [*before.pop("earlier_sessions", []), before]}
    except (OSError, ValueError):
        pass
    replace_text(path, json.dumps(content, indent=2) + "\n")


def append_row(path: Path, row: Row) -> None:
    """Appends a line that is on disk when this returns; the first row of a file fixes its columns."""
    is_new = not path.exists() or path.stat().st_size == 0
    columns = _columns(row) if is_new else _header(path)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    if is_new:
        writer.writerow(columns)
    writer.writerow([_cell(row.get(name, math.nan)) for name in columns])
    with open(path, "a", encoding="utf-8", newline="") as file:
        file.write(buffer.getvalue())
        file.flush()
        os.fsync(file.fileno())


def read_rows(path: Path) -> list[Row]:
    """All complete rows; a last line that was cut off is left out."""
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    lines = list(csv.reader(text[: text.rfind("\n") + 1].splitlines()))
    if not lines:
        return []
    complete = [line for line in lines[1:] if len(line) == len(lines[0])]
    return [{name: _number(name, cell) for name, cell in zip(lines[0], line, strict=True)} for line in complete]


def keep_rows_before(path: Path, update: int) -> list[Row]:
    """Removes rows from `update` on, and any torn line; what remains is returned."""
    rows = [row for row in read_rows(path) if row["update"] < update]
    if path.exists():
        write_rows(path, rows)
    return rows


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Replaces the file; all rows have the same columns, and without any the file is empty."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerows([list(rows[0]), *([_cell(x) for x in row.values()] for row in rows)] if rows else [])
    replace_text(path, buffer.getvalue())


def draw_curve(path: Path, rows: Sequence[Row], title: str) -> None:
    """Evaluation return against agent steps; the figure's format is the suffix.

    Of several seeds it shows the median with the quartiles, and each seed thin behind it; of one the mean with the
    standard deviation over episodes.
    """
    seeds, _ = curves.from_rows(rows, "agent_steps", RETURN)
    if len(seeds) > 1:
        line, what = curves.summarize(list(seeds.values()), "median"), f"median and quartiles of {len(seeds)} seeds"
        series = plots.Series("", line, seeds=list(seeds.values()))
    else:
        line, what = _mean_over_episodes(rows), "mean ± std"
        series = plots.Series("", line)
    label = f"return of an episode ({what})"
    caption = "pale where some seeds have no evaluation" if np.unique(line.num_seeds).size > 1 else ""
    plots.draw(path, plots.Picture("curve", [series], "agent_steps", RETURN, label, title=title, caption=caption))


def _mean_over_episodes(rows: Sequence[Row]) -> curves.Line:
    points = [row for row in rows if math.isfinite(row[RETURN])]
    x = np.array([row["agent_steps"] for row in points], float)
    y, spread = (np.array([row.get(name, math.nan) for row in points], float) for name in (RETURN, f"{RETURN}_std"))
    return curves.Line(x, y, y - spread, y + spread, np.ones(len(x), int))


class Progress:
    """Rate, latest evaluation and time left: a bar on a terminal, a line now and then elsewhere."""

    def __init__(self, update: int, num_updates: int, agent_steps_per_update: int, is_shown: bool = True):
        self._num_updates = num_updates
        self._agent_steps_per_update = agent_steps_per_update
        self._is_shown = is_shown
        self._first: tuple[float, int] | None = None  # when the first chunk was done
        self._last_line = -math.inf
        self._started = time.monotonic()
        self._update = update
        self._bar = self._make_bar() if is_shown else None

    def __enter__(self) -> "Progress":
        if self._bar:
            self._bar.start()
        elif self._is_shown:
            print("compiling ...", flush=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def begin(self) -> None:
        """Shows that compiling is over: the first chunk of a slow run takes minutes."""
        if self._bar:
            self._bar.update(self._task, rate="training")
        elif self._is_shown:
            print(f"compiled in {time.monotonic() - self._started:.0f} s; training ...", flush=True)

    def advance(self, update: int, evaluation: float | None) -> None:
        """Shows that so many updates are done; `evaluation` is the latest return."""
        now = time.monotonic()
        self._update = update
        self._first = self._first or (now, update)
        seconds, updates = now - self._first[0], update - self._first[1]
        rate = updates * self._agent_steps_per_update / seconds if updates else math.nan
        left = (self._num_updates - update) * seconds / updates if updates else math.nan
        return_text = "-" if evaluation is None else f"{evaluation:.1f}"
        rate_text = f"{_short(rate)} agent steps/s" if updates else "measuring speed"
        left_text = f"{_clock(left)} left" if updates else "-:-- left"
        if self._bar:
            self._bar.update(
                self._task, completed=update, rate=rate_text, evaluation=f"return {return_text}", left=left_text
            )
        elif self._is_shown and (now - self._last_line >= SECONDS_BETWEEN_LINES or update == self._num_updates):
            self._last_line = now
            done = f"update {update}/{self._num_updates}"
            print(f"{done} · return {return_text} · {rate_text} · {left_text}", flush=True)

    def warn(self, text: str) -> None:
        """Prints a line, above the bar if there is one."""
        if self._bar:
            self._bar.console.print(f"warning: {text}", markup=False, highlight=False)
        elif self._is_shown:
            print(f"warning: {text}", flush=True)

    def _make_bar(self) -> Any:
        from rich import console, progress  # noqa: PLC0415

        screen = console.Console()
        is_bare = screen.is_jupyter and importlib.util.find_spec("ipywidgets") is None  # a bar would warn, and not move
        if is_bare or not (screen.is_terminal or screen.is_jupyter):
            return None
        columns = (
            progress.TextColumn("update {task.completed}/{task.total}"),
            progress.BarColumn(bar_width=None),
            progress.TextColumn("{task.fields[evaluation]}", style="bold"),
            progress.TextColumn("{task.fields[rate]}"),
            progress.TextColumn("{task.fields[left]}"),
        )
        bar = progress.Progress(*columns, console=screen, refresh_per_second=4, expand=True)
        fields: Any = {"rate": "compiling", "evaluation": "return -", "left": "-:-- left"}
        self._task = bar.add_task("", total=self._num_updates, completed=self._update, **fields)
        return bar


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_revision() -> str | None:
    """Commit of the checkout that this package runs from, marked if files differ from it."""
    checkout = Path(__file__).resolve().parent.parent
    if not (checkout / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _columns(row: Mapping[str, Any]) -> list[str]:
    return [name for name in LEADING if name in row] + sorted(set(row) - set(LEADING))


def _header(path: Path) -> list[str]:
    with open(path, encoding="utf-8", newline="") as file:
        return next(csv.reader(file))


def _cell(value: Any) -> str:
    """Shortest text that reads back to the same number; metrics are single precision."""
    if isinstance(value, int):
        return str(value)
    return "" if math.isnan(value) else str(np.float32(value))


def _number(name: str, cell: str) -> float | int:
    if name in INTEGERS:
        return int(cell)
    return float(cell) if cell else math.nan


def _short(number: float) -> str:
    """Three digits and a unit: 41.2k."""
    for scale, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= scale:
            return f"{number / scale:.3g}{unit}"
    return f"{number:.3g}"


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
