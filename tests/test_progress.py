"""Progress display in logs and in notebooks."""

import io
import re
import sys

import pytest

from jaxswarm.host.progress import Progress


def test_without_a_terminal_progress_is_a_line_now_and_then(capsys):
    with Progress(0, 1000, 500) as progress:
        progress.begin()
        for update in range(1, 1001):
            progress.advance(update, (5 * (update // 5), -12.345) if update > 1 else None)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["compiling ...", "compiled in 0 s; training ..."]
    assert lines[2].startswith("update 1/1000 · no evaluation yet · ")
    assert lines[-1].startswith("update 1000/1000 · evaluation return -12.3 at update 1000 · ")
    assert "agent steps/s · 0:00 left" in lines[-1]
    assert len(lines) == 4


def test_the_phase_after_the_last_update_is_announced(capsys):
    with Progress(0, 2, 500) as progress:
        progress.announce("evaluating the final policy")
    assert capsys.readouterr().out.splitlines()[-1] == "evaluating the final policy ..."


def test_silent_progress_says_nothing(capsys):
    with Progress(0, 2, 500, is_shown=False) as progress:
        progress.begin()
        progress.advance(2, (0, 1.0))
    assert capsys.readouterr().out == ""


def test_notebooks_without_widgets_get_lines(capsys, monkeypatch):
    """Without ipywidgets, rich warns and draws a bar that does not move."""
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with Progress(0, 2, 500) as progress:
        progress.advance(2, (0, 1.0))
    assert capsys.readouterr().out.splitlines()[-1].startswith("update 2/2 · evaluation return 1.0 at update 0")


class Terminal(io.StringIO):
    """A terminal that records what is written to it."""

    def isatty(self):
        return True


@pytest.mark.parametrize(("columns", "is_wide"), [("40", False), ("100", True)])
def test_a_narrow_terminal_shows_update_and_return(monkeypatch, columns, is_wide):
    monkeypatch.setattr(sys, "stdout", terminal := Terminal())
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setenv("TERM", "xterm")
    with Progress(0, 3000, 500) as progress:
        progress.advance(1500, (1495, -33.3))
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    assert re.search(r"update 1500/3000.*evaluation return -33.3", text)
    assert ("at update 1495" in text) == ("left" in text) == is_wide


@pytest.mark.parametrize("environment", [{"TERM": "dumb"}, {"FORCE_COLOR": "1", "TERM": "xterm"}])
def test_dumb_terminals_and_files_get_lines(monkeypatch, environment):
    stream = Terminal() if environment["TERM"] == "dumb" else io.StringIO()
    monkeypatch.setattr(sys, "stdout", stream)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with Progress(0, 2, 500) as progress:
        progress.advance(2, (0, 1.0))
    assert stream.getvalue().startswith("compiling ...\nupdate 2/2 · evaluation return 1.0 at update 0 · ")
