"""Code in a run folder is executed only if this user has trained with it, or allows it."""

import shutil
import sys
from unittest import mock

import pytest

import jaxswarm
from jaxswarm import config as configs
from jaxswarm.cli import evaluate, export, render, train
from jaxswarm.config import ConfigError, plugins

TASK = """
import pathlib, jaxswarm
from jaxswarm.types import pytree
pathlib.Path({touched!r}).touch()
@pytree
class Mine(jaxswarm.TASKS["rendezvous"]):
    "A task of a user."
jaxswarm.TASKS["mine"] = Mine
"""
TINY = [
    "task.num_agents=3",
    "task.episode_length=5",
    "num_envs=2",
    "num_steps=4",
    "learner.batch_size=12",
    "num_eval_envs=1",
    "network.encoder=[4]",
    "network.decoder=[4]",
    "num_updates=1",
]


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """Give the user an empty list of trusted code, and restore registries and imports."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(plugins, "have_run", set())
    monkeypatch.setattr(plugins, "_is_substituted", False)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    with mock.patch.dict(jaxswarm.TASKS), mock.patch.dict(sys.modules):
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return the folder of a run that its maker has trained with a file of their own."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "mine.py").write_text(TASK.format(touched=str(folder / "touched")))
    state, have_run = str(folder / "state"), set()
    with pytest.MonkeyPatch.context() as patch, mock.patch.dict(jaxswarm.TASKS), mock.patch.dict(sys.modules):
        patch.setenv("XDG_STATE_HOME", state)
        patch.setattr(plugins, "have_run", have_run)
        assert train.main([f"imports={folder / 'mine.py'}", "task=mine", *TINY, f"run_dir={folder / 'run'}"]) == 0
    return folder


@pytest.fixture
def foreign(made, tmp_path):
    """Return a copy of the run folder, as somebody else receives it."""
    (made / "touched").unlink(missing_ok=True)
    return shutil.copytree(made / "run", tmp_path / "foreign")


PROGRAMS = {
    "resume": lambda run: train.main([f"resume={run}", "num_updates=2"]),
    "init_from": lambda run: train.main([f"init_from={run}", *TINY, "run_dir=new"]),
    "evaluate": lambda run: evaluate.main([str(run), "episodes=1"]),
    "render": lambda run: render.main([str(run), "out=replay.html"]),
    "export": lambda run: export.main([str(run), "out=policy.stablehlo"]),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_no_program_executes_foreign_code(name, foreign, made, capsys):
    assert PROGRAMS[name](foreign) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    assert str(foreign / "imports" / "0-mine.py") in error
    assert "trust=true" in error
    assert "imports=PATH" in error
    assert plugins.digest(foreign / "imports" / "0-mine.py") in error
    assert not (made / "touched").exists()


def test_load_executes_foreign_code_only_on_request(foreign, made):
    with pytest.raises(ConfigError, match="trust=True"):
        jaxswarm.load(foreign)
    assert not (made / "touched").exists()
    experiment, _ = jaxswarm.load(foreign, trust=True)
    assert type(experiment.task).__name__ == "Mine"
    assert (made / "touched").exists()


def test_a_program_executes_foreign_code_on_request(foreign, made):
    assert evaluate.main([str(foreign), "episodes=1", "trust=true"]) == 0
    assert (made / "touched").exists()


def test_the_users_own_file_replaces_foreign_code(foreign, made, tmp_path):
    (tmp_path / "own.py").write_text(TASK.format(touched=str(tmp_path / "own")))
    assert evaluate.main([str(foreign), "episodes=1", f"imports={tmp_path / 'own.py'}"]) == 0
    assert (tmp_path / "own").exists()
    assert not (made / "touched").exists()


def test_the_maker_trusts_the_run(foreign, made, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(made / "state"))
    jaxswarm.load(foreign)
    assert (made / "touched").exists()


def test_an_edited_copy_is_not_trusted(foreign, made, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(made / "state"))
    copy = foreign / "imports" / "0-mine.py"
    copy.write_text(copy.read_text() + "\n")
    with pytest.raises(ConfigError, match=r"0-mine\.py"):
        jaxswarm.load(foreign)
    assert not (made / "touched").exists()


def test_an_edited_copy_is_refused_for_exact_resume(foreign, capsys):
    copy = foreign / "imports" / "0-mine.py"
    copy.write_text(copy.read_text() + "\n")
    assert train.main([f"resume={foreign}", "num_updates=2", "trust=true"]) == 2
    assert "0-mine.py has been changed since the checkpoint" in capsys.readouterr().err


def test_files_outside_of_the_folder_are_never_executed(foreign, made):
    shutil.rmtree(foreign / "imports")
    with pytest.raises(ConfigError, match=r"has no copy of .*mine\.py"):
        jaxswarm.load(foreign, trust=True)
    assert not (made / "touched").exists()


def test_a_compiled_file_beside_the_copy_is_never_executed(foreign, made, monkeypatch, tmp_path):
    import py_compile  # noqa: PLC0415

    monkeypatch.setenv("XDG_STATE_HOME", str(made / "state"))
    copy = foreign / "imports" / "0-mine.py"
    content = copy.read_bytes()
    copy.write_text(f"import pathlib; pathlib.Path({str(tmp_path / 'attacked')!r}).touch()")
    py_compile.compile(str(copy), invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH)
    copy.write_bytes(content)
    jaxswarm.load(foreign)
    assert not (tmp_path / "attacked").exists()


@pytest.mark.parametrize("trust", [False, True])
def test_modules_of_the_working_directory_are_never_executed(trust, foreign, tmp_path):
    config = configs.read(foreign / "config.yaml") | {"imports": ["here"]}
    (foreign / "config.yaml").write_text(configs.dump(config))
    (tmp_path / "here.py").write_text(TASK.format(touched=str(tmp_path / "attacked")))
    with pytest.raises(ConfigError, match="here"):
        jaxswarm.load(foreign, trust=trust)
    assert not (tmp_path / "attacked").exists()


def test_an_own_module_of_the_working_directory_is_copied(tmp_path):
    (tmp_path / "mytask.py").write_text(TASK.format(touched=str(tmp_path / "touched")))
    assert train.main(["imports=mytask", "task=mine", *TINY, "run_dir=run"]) == 0
    assert [path.name for path in (tmp_path / "run" / "imports").iterdir()] == ["0-mytask.py"]
    jaxswarm.TASKS.pop("mine")
    plugins.have_run.clear()
    assert type(jaxswarm.load(tmp_path / "run")[0].task).__name__ == "Mine"
