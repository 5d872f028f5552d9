"""Options of the program `jaxswarm-plot`."""

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path

from jaxswarm.analysis import plots
from jaxswarm.analysis.curves import STATISTICS
from jaxswarm.analysis.plots import Layout
from jaxswarm.cli.program import parse_integer, split
from jaxswarm.config import ConfigError, schema

HELP = """\
jaxswarm-plot PATH... [key=value ...]

Plots learning curves of runs with their spread over seeds, and writes the points as CSV next to the plot. Runs form a
group if they differ only in seed, length, checkpoints and times of evaluation. Groups are labeled by the settings that
differ. Each task, and each reward of a task, has a panel of its own. If a setting differs on which the scale of the
return depends, such as task.visibility_radius, the panel shows a metric that does not depend on it.

options
  PATH...                  Run folders, or folders that contain run folders. Required.
  out=FILE                 Path of the plot: .png, .svg or .pdf, default: plot.png.
  kind=KIND                Kind of plot, default: curve.
                           curve: a statistic over seeds against x.
                           profile: the fraction of seeds that end above each value of y.
                           threshold: the fraction of seeds that have reached a value of y, against x.
  threshold=VALUE          Value of kind=threshold. Number, required there.
  statistic=NAME           Statistic of kind=curve, default: median.
                           median: median with quartiles.
                           iqm: interquartile mean with 95 % stratified bootstrap intervals.
  labels=KEY,...           Label groups by these settings, or label each run folder by its name and plot it alone with
                           labels=run, default: the settings that differ.
  color=KEY                Color lines by a setting; the legend then shows its values, default: a color per label.
  size=WIDTH or WxH        Width of the figure and height of a row of panels in inches, such as size=3.3 or size=7x3,
                           default: 7, with a height that fits. A legend below the panels is added.
  columns=N                Panels per row. Integer >= 1, default: as many as are at least 3.2 inches wide.
  seeds=BOOL               Also plot each seed of kind=curve as a thin line: true or false, default: false.
  y=COLUMN                 Column of metrics.csv for the vertical axis, default: eval/return, or the metric that
                           is comparable.
  x=COLUMN                 Horizontal axis: agent_steps, env_steps, wall_seconds or update, default: agent_steps.
  log=AXES                 Logarithmic axes: x, y or xy, default: none.
  smooth=N                 Replace each evaluation of a seed by the mean of the last N. Integer >= 1, default: 1.
  reference=FILE.csv,...   Overlay the curves of CSV files with the columns series, agent_steps, median, q25 and q75,
                           default: none.
  series=TEXT              Overlay only references whose names contain the text, default: all.
  title=TEXT               Title of the plot, default: each panel names the parts that all its groups share.

examples
  jaxswarm-plot runs
  jaxswarm-plot runs/a runs/b out=figure.pdf statistic=iqm log=x
  jaxswarm-plot runs color=learning_rate size=3.3
  jaxswarm-plot runs kind=threshold threshold=-30 x=wall_seconds
"""
KINDS = ("curve", "profile", "threshold")
UNITS = {"agent_steps": "agent steps", "env_steps": "environment steps", "wall_seconds": "seconds", "update": "updates"}
CHOICES = {
    "kind": KINDS,
    "statistic": tuple(STATISTICS),
    "seeds": ("false", "true"),
    "x": tuple(UNITS),
    "log": ("", "x", "y", "xy"),
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the program, as text from the command line."""

    out: str = ""
    kind: str = "curve"
    threshold: str = ""
    statistic: str = "median"
    seeds: str = "false"
    y: str = ""
    x: str = "agent_steps"
    log: str = ""
    smooth: str = "1"
    reference: str = ""
    series: str = ""
    title: str = ""
    labels: str = ""
    color: str = ""
    size: str = ""
    columns: str = ""

    def __post_init__(self) -> None:
        for name, accepted in CHOICES.items():
            if getattr(self, name) not in accepted:
                choices = ", ".join(filter(None, accepted))
                raise ConfigError(f"{name}: must be one of {choices}, got {getattr(self, name)!r}")
        parse_integer("smooth", self.smooth, 1)
        self.layout  # noqa: B018 raises for a wrong size
        if self.kind == "threshold" and not _is_number(self.threshold):
            raise ConfigError(f"threshold: must be a number such as threshold=-30, got {self.threshold!r}")
        if self.threshold and self.kind != "threshold":
            raise ConfigError(f"threshold: must be used with kind=threshold, got kind={self.kind}")
        if self.statistic != Options.statistic and self.kind != "curve":
            raise ConfigError(f"statistic: must be used with kind=curve, got kind={self.kind}")
        if self.seeds == "true" and self.kind != "curve":
            raise ConfigError(f"seeds: must be used with kind=curve, got kind={self.kind}")
        if self.reference and (self.kind, self.x) != ("curve", "agent_steps"):
            raise ConfigError(
                f"reference: must be used with kind=curve and x=agent_steps, got {self.kind} and {self.x}"
            )
        if self.series and not self.reference:
            raise ConfigError("series: must be used with reference=FILE.csv")
        if self.log and self.kind != "curve" and (self.log, self.kind) != ("x", "threshold"):
            raise ConfigError(f"log: must be used with kind=curve, got kind={self.kind}")

    @property
    def layout(self) -> Layout:
        """Sizes of the figure and number of panels per row."""
        width, x, height = self.size.partition("x")
        numbers = [width, height] if x else [width]
        if self.size and not all(_is_number(number) and 1 <= float(number) <= 100 for number in numbers):
            raise ConfigError(f"size: must be WIDTH or WIDTHxHEIGHT in inches, from 1 to 100, got {self.size!r}")
        columns = parse_integer("columns", self.columns, 1) if self.columns else None
        return Layout(float(width) if self.size else Layout.width, float(height) if height else None, columns)


def parse(arguments: Sequence[str]) -> tuple[Options, list[Path]]:
    """Return options and paths. An argument that exists as a file or folder is a path, even if it contains "="."""
    names = [field.name for field in dataclasses.fields(Options)]
    options, overrides = split(arguments, names)
    for word in overrides:
        name, equals, _ = word.partition("=")
        if equals and not os.path.exists(word):
            near = schema.nearest(name, names)
            raise ConfigError(f"unknown key {name!r}{near}; valid keys: {', '.join(names)}")
    if not overrides:
        raise ConfigError("give a run folder, or a folder that contains some: jaxswarm-plot PATH... [key=value ...]")
    return Options(**options), [Path(word) for word in overrides]


def output_path(out: str) -> Path:
    """Return the path of the plot.

    Raises a `ConfigError` if the plot or its table would replace a file that this program did not write.
    """
    path = Path(out or "plot.png")
    if path.suffix[1:].lower() not in plots.FORMATS:
        raise ConfigError(f"out: must be one of {', '.join(f'FILE.{x}' for x in plots.FORMATS)}, got {out!r}")
    table = path.with_suffix(".csv")
    if path.is_dir() or table.is_dir():
        raise ConfigError(f"out: must be a file, got the folder {out!r}")
    is_ours = table.exists() and table.read_bytes().startswith(",".join(plots.COLUMNS[:4]).encode())
    if table.exists() and not is_ours:
        raise ConfigError(f"out={path} would replace {table}, which jaxswarm-plot did not write; choose another name")
    if not out and path.exists() and not is_ours:
        raise ConfigError(f"{path} exists, and jaxswarm-plot did not write it; choose a name with out=FILE.png")
    return path


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
