"""Progress display in logs and in notebooks."""

from jaxswarm.host.progress import Progress


def test_without_a_terminal_progress_is_a_line_now_and_then(capsys):
    with Progress(0, 1000, 500) as progress:
        progress.begin()
        for update in range(1, 1001):
            progress.advance(update, -12.345 if update > 1 else None)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["compiling ...", "compiled in 0 s; training ..."]
    assert lines[2].startswith("update 1/1000 · return -")
    assert lines[-1].startswith("update 1000/1000 · return -12.3")
    assert "agent steps/s · 0:00 left" in lines[-1]
    assert len(lines) == 4


def test_silent_progress_says_nothing(capsys):
    with Progress(0, 2, 500, is_shown=False) as progress:
        progress.begin()
        progress.advance(2, 1.0)
    assert capsys.readouterr().out == ""


def test_notebooks_without_widgets_get_lines(capsys, monkeypatch):
    """Without ipywidgets, rich warns and draws a bar that does not move."""
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with Progress(0, 2, 500) as progress:
        progress.advance(2, 1.0)
    assert capsys.readouterr().out.splitlines()[-1].startswith("update 2/2 · return 1.0")
