"""Progress display of training: a bar on a terminal, and a line every 10 s elsewhere."""

import importlib.util
import math
import sys
import time
from typing import Any

SECONDS_BETWEEN_LINES = 10.0  # without a terminal
NARROW = 72  # columns below which a terminal shows only the update and the evaluation return


class Progress:
    """Display of speed, latest evaluation and remaining time: a bar on a terminal, lines elsewhere.

    Use it as a context manager, which shows that the program is being compiled. `is_shown=False` prints nothing.
    """

    def __init__(self, update: int, num_updates: int, agent_steps_per_update: int, is_shown: bool = True):
        self._num_updates = num_updates
        self._agent_steps_per_update = agent_steps_per_update
        self._is_shown = is_shown
        self._first: tuple[float, int] | None = None  # time and update at the end of the first chunk
        self._last_line = -math.inf
        self._started = time.monotonic()
        self._update = update
        self._is_narrow = False
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
        """Show that compilation is finished. The first chunk of a slow run may take minutes."""
        if self._bar:
            self._bar.update(self._task, rate="training")
        elif self._is_shown:
            print(f"compiled in {time.monotonic() - self._started:.0f} s; training ...", flush=True)

    def announce(self, text: str) -> None:
        """Show what happens after the last update."""
        if self._bar:
            self._bar.update(self._task, rate=text, left="")
        elif self._is_shown:
            print(f"{text} ...", flush=True)

    def advance(self, update: int, evaluation: tuple[int, float] | None) -> None:
        """Show that `update` updates are done.

        `evaluation` is the latest one: the number of updates before it, and its return; `None` before the first one.
        """
        now = time.monotonic()
        self._update = update
        self._first = self._first or (now, update)
        seconds, updates = now - self._first[0], update - self._first[1]
        rate = updates * self._agent_steps_per_update / seconds if updates else math.nan
        left = (self._num_updates - update) * seconds / updates if updates else math.nan
        rate_text = f"{_short(rate)} agent steps/s" if updates else "measuring speed"
        left_text = f"{_clock(left)} left" if updates else "-:-- left"
        if self._bar:
            self._bar.update(
                self._task, completed=update, rate=rate_text, evaluation=self._evaluation(evaluation), left=left_text
            )
        elif self._is_shown and (now - self._last_line >= SECONDS_BETWEEN_LINES or update == self._num_updates):
            self._last_line = now
            done = f"update {update}/{self._num_updates}"
            print(f"{done} · {self._evaluation(evaluation)} · {rate_text} · {left_text}", flush=True)

    def warn(self, text: str) -> None:
        """Print a warning, above the bar if there is one."""
        if self._bar:
            self._bar.console.print(f"warning: {text}", markup=False, highlight=False)
        elif self._is_shown:
            print(f"warning: {text}", flush=True)

    def _evaluation(self, evaluation: tuple[int, float] | None) -> str:
        """Format the latest evaluation; a narrow bar has no room for its update."""
        if evaluation is None:
            return "no evaluation yet"
        update, value = evaluation
        return f"evaluation return {value:.1f}" + ("" if self._is_narrow else f" at update {update}")

    def _make_bar(self) -> Any:
        from rich import console, progress  # noqa: PLC0415

        screen = console.Console()
        # Without ipywidgets, rich warns and its bar does not move in notebooks.
        is_bare = screen.is_jupyter and importlib.util.find_spec("ipywidgets") is None
        is_terminal = sys.stdout.isatty() and not screen.is_dumb_terminal  # rich trusts FORCE_COLOR, also for files
        if is_bare or not (is_terminal or screen.is_jupyter):
            return None
        essential = (
            progress.TextColumn("update {task.completed}/{task.total}"),
            progress.TextColumn("{task.fields[evaluation]}", style="bold"),
        )
        rest = (
            progress.BarColumn(bar_width=None),
            progress.TextColumn("{task.fields[rate]}"),
            progress.TextColumn("{task.fields[left]}"),
        )
        self._is_narrow = screen.width < NARROW
        columns = essential if self._is_narrow else essential + rest
        bar = progress.Progress(*columns, console=screen, refresh_per_second=4, expand=True)
        fields: Any = {"rate": "compiling", "evaluation": "no evaluation yet", "left": "-:-- left"}
        self._task = bar.add_task("", total=self._num_updates, completed=self._update, **fields)
        return bar


def _short(number: float) -> str:
    """Format a number with three digits and a unit, such as 41.2k."""
    for scale, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= scale:
            return f"{number / scale:.3g}{unit}"
    return f"{number:.3g}"


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
