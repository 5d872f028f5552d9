"""Every program answers `--help` and `-h`, also between other arguments, and does nothing else."""

import pytest

from jaxswarm.cli import evaluate, export, figure, plot, render, sweep, train

PROGRAMS = (train, sweep, evaluate, render, export, plot, figure)


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda module: module.__name__.rpartition(".")[2])
@pytest.mark.parametrize("arguments", [["--help"], ["-h"], ["num_envs=3", "--help"]])
def test_every_program_has_help(program, arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert program.main(arguments) == 0
    captured = capsys.readouterr()
    assert captured.out.startswith(program.HELP)
    assert not captured.err
    assert not list(tmp_path.iterdir())
