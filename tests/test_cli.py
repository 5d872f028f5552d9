import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxswarm
from jaxswarm import config as configs
from jaxswarm import files, rollout
from jaxswarm.cli import evaluate, train
from jaxswarm.cli import program as commands
from jaxswarm.config import plugins as imports
from jaxswarm.host import checkpoint
from jaxswarm.host import trained as policies
from jaxswarm.host.ensemble import abstract_state

TINY = [
    *("task.num_agents=3", "task.episode_length=5", "num_envs=2", "num_steps=4", "learner.batch_size=12"),
    *("num_eval_envs=2", "eval_every=3", "network.encoder=[4]", "network.decoder=[4]", "seed=5"),
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("runs") / "finished"
    assert train.main([*TINY, "num_updates=4", f"run_dir={run_dir}"]) == 0
    return run_dir


def test_training_ends_with_its_files_and_the_next_command(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, "num_updates=4"]) == 0
    out = capsys.readouterr().out
    (run_dir,) = (tmp_path / "runs").iterdir()
    assert run_dir.name.startswith("rendezvous-mean-ppo-")
    names = {"config.yaml", "manifest.json", "metrics.csv", "checkpoints", "curve.png", "replay.html"}
    assert {path.name for path in run_dir.iterdir()} == names
    assert all(f"{run_dir.relative_to(tmp_path)}/{name}" in out for name in names)
    assert out.splitlines()[-1].startswith("next: jaxswarm-eval runs/rendezvous-mean-ppo-")
    same = [files.read_rows(path / "metrics.csv") for path in (run_dir, finished)]
    assert [row["eval/return"] for row in same[0]] == [row["eval/return"] for row in same[1]]
    assert {row["seed"] for row in same[0]} == {5}


def test_what_was_compiled_is_kept_for_the_next_start(finished):
    assert jax.config.jax_compilation_cache_dir == os.path.join(os.environ["XDG_CACHE_HOME"], "jaxswarm", "xla")
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0


def test_a_run_folder_is_never_overwritten(finished, capsys):
    assert train.main([*TINY, f"run_dir={finished}"]) == 2
    assert f"resume={finished}" in capsys.readouterr().err


def test_resuming_a_finished_run_says_so(finished, capsys):
    assert train.main([f"resume={finished}"]) == 0
    assert "is finished: 4 of 4 updates" in capsys.readouterr().out


def test_a_finished_run_can_be_made_longer(finished, capsys):
    assert train.main([f"resume={finished}", "num_updates=5"]) == 0
    assert [row["update"] for row in files.read_rows(finished / "metrics.csv")] == [0, 3, 5]
    assert "num_updates: 5" in (finished / "config.yaml").read_text()


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (["num_updates=2"], ["2 updates", "at least 4 updates"]),
        (["learner.learning_rate=1"], ["learner.learning_rate=1: a resumed run keeps its settings", "init_from="]),
        (["learner.rate=1"], ["learner.rate cannot be changed here", "num_updates=N"]),
        (["run_dir=x"], ["one of run_dir and resume"]),
    ],
)
def test_nothing_but_the_length_changes_on_resume(finished, capsys, overrides, parts):
    parts = [part.replace("4 updates", "5 updates") for part in parts]
    assert train.main([f"resume={finished}", "num_updates=5"]) == 0
    assert train.main([f"resume={finished}", *overrides]) == 2
    err = capsys.readouterr().err
    assert all(part in err for part in parts), err


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (["task.num_agent=5"], ["did you mean 'task.num_agents'"]),
        (["learner.batch_size=7"], ["batch_size: must ", "got 7", "divide"]),
        (["num_envs=0"], ["num_envs: must ", "got 0"]),
        (["--verbose"], ["'--verbose'", "key=value"]),
        (["run_dir="], ["run_dir has no value"]),
        (["resume=nowhere"], ["nowhere is not a run folder"]),
    ],
)
def test_a_wrong_command_is_one_line_and_writes_nothing(tmp_path, monkeypatch, capsys, overrides, parts):
    monkeypatch.chdir(tmp_path)
    assert train.main(overrides) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert all(part in captured.err for part in parts), captured.err
    assert not captured.out
    assert not list(tmp_path.iterdir())


def test_a_reader_that_goes_away_is_no_mistake():
    reader, writer = os.pipe()
    os.close(reader)
    program = "import sys; from jaxswarm.cli.sweep import main; sys.exit(main(['--help']))"
    run = [sys.executable, "-c", program]
    ended = subprocess.run(run, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (141, "")


@pytest.mark.parametrize(
    ("error", "code", "part"),
    [
        (PermissionError(13, "Permission denied", "runs/x"), 2, "runs/x: Permission denied"),
        (OSError(28, "No space left on device", "runs/x"), 1, "runs/x: No space left on device"),
        (
            RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.\nmore"),
            1,
            "error: out of memory; reduce",
        ),
    ],
)
def test_what_machines_refuse_is_one_line(error, code, part, capsys):
    @commands.program
    def main(arguments):
        raise error

    assert main([]) == code
    err = capsys.readouterr().err
    assert part in err
    assert err.count("\n") == 1


def test_other_errors_are_not_hidden():
    @commands.program
    def main(arguments):
        raise RuntimeError("a mistake in the program")

    with pytest.raises(RuntimeError, match="mistake"):
        main([])


def test_help_shows_groups_choices_and_keys(capsys):
    assert train.main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(part in out for part in ("task=rendezvous", "learner=ppo_thesis", "num_envs=32 ", "resume=PATH"))
    assert train.main(["task=pursuit_multi", "--help"]) == 0
    out = capsys.readouterr().out
    assert all(part in out for part in ("keys of task=pursuit_multi", "task.num_evaders=5 ", "learner.clip_range=0.2 "))
    assert "task.num_evaders=1 " not in out
    assert train.main(["task=pursuits", "--help"]) == 2
    assert "did you mean 'pursuit'" in capsys.readouterr().err
    assert train.main(["--version"]) == 0
    assert capsys.readouterr().out == f"jaxswarm {jaxswarm.__version__}\n"
    assert evaluate.main(["-h"]) == 0
    assert "task.num_agents=5,10" in capsys.readouterr().out


def test_what_users_registered_has_help(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(imports, "have_run", set())
    text = "import jaxswarm\njaxswarm.TASKS['again'] = type('Again', (jaxswarm.TASKS['pursuit'],), {})\n"
    (tmp_path / "mine.py").write_text(text)
    with mock.patch.dict(jaxswarm.TASKS):
        assert train.main([f"imports={tmp_path / 'mine.py'}", "task=again", "--help"]) == 0
    out = capsys.readouterr().out
    assert "task=again" in out
    assert "task.num_evaders=1 " in out


def test_a_larger_swarm_begins_with_the_policy_of_a_smaller_one(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(finished.parent)
    overrides = [*TINY, "task.num_agents=6", "num_updates=1", "init_from=finished", f"run_dir={tmp_path / 'larger'}"]
    assert train.main(overrides) == 0
    assert "(warm start " in capsys.readouterr().out
    params = policies.load(finished)[1]
    larger = configs.build(configs.load(tmp_path / "larger" / "config.yaml"))
    start = jaxswarm.init(larger, jax.random.key(5))
    start = start.replace(learner=start.learner.replace(params=params))
    first = files.read_rows(tmp_path / "larger" / "metrics.csv")[0]
    assert first["eval/return"] == pytest.approx(float(jaxswarm.evaluate(larger, start)["eval/return"]), abs=1e-4)
    monkeypatch.chdir(tmp_path)
    moved = finished.rename(tmp_path / "moved")
    assert train.main([f"resume={tmp_path / 'larger'}", "num_updates=2"]) == 0  # needs no folder of the warm start
    moved.rename(finished)
    capsys.readouterr()
    assert train.main([*TINY, "init_from=nowhere", "run_dir=other"]) == 2
    assert "init_from: must be a run folder, got" in capsys.readouterr().err
    assert train.main([*TINY, "network.encoder=[5]", f"init_from={finished}", "run_dir=other"]) == 2
    assert f"init_from={finished}: must have the parameter shapes" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_programs_take_folders_with_any_name(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = tmp_path / "a=b c"
    folder.mkdir()
    paths, options, others = commands.split_paths([str(folder), "out=~/x.html", "seed=1"], ("out",))
    assert (paths, options, others) == ([folder], {"out": str(tmp_path / "x.html")}, ["seed=1"])


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({}, "needs JAX_NUM_PROCESSES"),
        ({"JAX_NUM_PROCESSES": "x"}, "JAX_NUM_PROCESSES: must be an integer >= 1, got 'x'"),
    ],
)
def test_processes_that_do_not_know_their_number_are_told(monkeypatch, capsys, variables, message):
    for name in ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID"):
        monkeypatch.delenv(name, raising=False)
    for name, x in {"JAX_COORDINATOR_ADDRESS": "localhost:1", **variables}.items():
        monkeypatch.setenv(name, x)

    def initialize(num_processes, process_id):
        raise ValueError("Number of processes must be defined.")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    assert train.main([]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("overrides", [[], ["checkpoint=last", "num_agents=7", "episodes=3"]])
def test_a_policy_is_evaluated_also_with_more_agents(finished, capsys, overrides):
    assert evaluate.main([str(finished), "seed=1", *overrides]) == 0
    out = capsys.readouterr().out
    path = out.splitlines()[-1].removeprefix("wrote ")
    result = json.loads(Path(path).read_text())
    (played,) = result["results"]
    assert played["task"]["num_agents"] == (7 if overrides else 3)
    assert result["episodes"] == (3 if overrides else 2)
    assert f"{played['metrics']['return']:.4f}" in out


def test_a_policy_is_evaluated_in_swarms_of_several_sizes(finished, capsys):
    assert evaluate.main([str(finished), "task.num_agents=2,5", "task.torus=true,false"]) == 0
    lines = capsys.readouterr().out.splitlines()
    results = json.loads(Path(lines[-1].removeprefix("wrote ")).read_text())["results"]
    assert [result["task"]["num_agents"] for result in results] == [2, 2, 5, 5]
    table = {line.split()[0]: line.split()[1:] for line in lines[1:-1]}
    assert table["task.num_agents"] == ["2", "2", "5", "5"]
    assert table["task.torus"] == ["True", "False", "True", "False"]
    assert table["return"] == [f"{result['metrics']['return']:.4f}" for result in results]
    assert len(set(table["return"])) == 4


def test_a_policy_is_loaded(finished, tmp_path):
    experiment, params = jaxswarm.load(finished, which="last")
    state = checkpoint.restore(finished / "checkpoints", abstract_state(experiment)).train_state
    for found, expected in zip(jax.tree.leaves(params), jax.tree.leaves(state.learner.params), strict=True):
        np.testing.assert_array_equal(found, expected[0])
    obs = experiment.task.observe(experiment.task.reset(jax.random.key(0)))
    assert experiment.network.apply(params, obs, method="policy").mean().shape == (3, 2)
    with pytest.raises(configs.ConfigError, match="seed: must be one of the trained seeds 5 to 5, got 7"):
        jaxswarm.load(finished, seed=7)
    with pytest.raises(configs.ConfigError, match="is not a run folder"):
        jaxswarm.load(tmp_path)


def test_a_policy_outlives_the_rest_of_its_training_state(finished):
    config = configs.override(configs.load(finished / "config.yaml"), [("num_envs", 4), ("total_agent_steps", 480)])
    assert policies.load_policies(finished, config, "best", [5]).params is not None  # of two envs


def test_metrics_of_which_there_are_none_are_null(finished, capsys, monkeypatch):
    monkeypatch.setattr(rollout, "evaluate", lambda *_: {"return": jnp.ones(()), "capture_time": jnp.full((), jnp.nan)})

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(files, "replace_text", full)
        assert evaluate.main([str(finished)]) == 1
    assert "capture_time" in capsys.readouterr().out  # the table is printed before the file is written
    assert evaluate.main([str(finished)]) == 0
    *_, table, wrote = capsys.readouterr().out.splitlines()
    assert table.split() == ["capture_time", "-"]
    text = Path(wrote.removeprefix("wrote ")).read_text()
    (played,) = json.loads(text, parse_constant=pytest.fail)["results"]
    assert played["metrics"] == {"return": 1.0, "capture_time": None}
    assert played["of_each_seed"] == {"return": [1.0], "capture_time": [None]}


@pytest.mark.parametrize(
    ("overrides", "part"),
    [
        (["checkpoint=first"], "must be one of best, last"),
        (["episodes=0"], "episodes: must be an integer >= 1, got"),
        (["episodes=many"], "episodes: must be an integer >= 1, got"),
        (["num_envs=3"], "num_envs cannot be changed here"),
        (["episode=3"], "did you mean 'episodes'"),
        (["task.num_agent=3"], "did you mean 'task.num_agents'"),
        (["task.num_agents=0"], "num_agents: must be an integer >= 2, got 0"),
        (["task.dynamics=velocity"], "observations of other sizes"),
        (["another"], "give one run folder"),
    ],
)
def test_a_wrong_evaluation_is_one_line(finished, capsys, overrides, part):
    assert evaluate.main([str(finished), *overrides]) == 2
    err = capsys.readouterr().err
    assert part in err
    assert err.count("\n") == 1


def test_a_folder_without_a_run_cannot_be_evaluated(tmp_path, capsys):
    assert evaluate.main([str(tmp_path)]) == 2
    assert "is not a run folder" in capsys.readouterr().err


def start(*overrides):
    program = "import sys; from jaxswarm.cli import train; sys.exit(train.main(sys.argv[1:]))"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", program, *map(str, overrides)], **pipes)


def table(run_dir):
    """Return the rows of metrics.csv without the time."""
    with open(run_dir / "metrics.csv", newline="") as file:
        return [{name: x for name, x in row.items() if name != "wall_seconds"} for row in csv.DictReader(file)]


def wait_for_rows(process, run_dir, num_rows):
    while process.poll() is None and len(files.read_rows(run_dir / "metrics.csv")) < num_rows:
        time.sleep(0.005)
    assert process.poll() is None, process.communicate()


@pytest.mark.slow
def test_killed_and_terminated_runs_resume_to_the_undisturbed_end(tmp_path, monkeypatch):
    overrides = [*TINY, "num_updates=900", "checkpoint_seconds=0.05"]
    undisturbed, run_dir = tmp_path / "undisturbed", tmp_path / "run"
    assert train.main([*overrides, f"run_dir={undisturbed}"]) == 0
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    process = start(*overrides, f"run_dir={run_dir}")
    for num_rows, number, code in ((30, signal.SIGKILL, -9), (80, signal.SIGKILL, -9), (130, signal.SIGTERM, 143)):
        wait_for_rows(process, run_dir, num_rows)
        process.send_signal(number)
        out, err = process.communicate(timeout=120)
        assert process.returncode == code, (out, err)
        assert "Traceback" not in err
        if number == signal.SIGTERM:
            assert f"resume with: jaxswarm-train resume={run_dir}" in out
        process = start(f"resume={run_dir}")
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, (out, err)
    compiled = list(Path(os.environ["XDG_CACHE_HOME"], "jaxswarm", "xla").glob("jit__advance*-cache"))
    assert compiled
    assert table(run_dir) == table(undisturbed)
    template = abstract_state(configs.build(configs.load(run_dir / "config.yaml")))
    states = [checkpoint.restore(path / "checkpoints", template) for path in (undisturbed, run_dir)]
    assert [state.update for state in states] == [900, 900]
    for a, b in zip(*(jax.tree.leaves(state.train_state.learner) for state in states), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
def test_a_task_of_ones_own_is_trained_evaluated_shown_and_plotted(tmp_path):
    (tmp_path / "mine.py").write_text(
        "import jaxswarm\nfrom jaxswarm.tasks import Rendezvous\nfrom jaxswarm.types import pytree\n"
        "@pytree\nclass Costly(Rendezvous):\n    price: float = 0.5\njaxswarm.TASKS['costly'] = Costly\n"
    )
    (tmp_path / "elsewhere").mkdir()

    def run(name, *overrides, cwd=tmp_path):
        command = [
            sys.executable,
            "-c",
            f"import sys; from jaxswarm.cli.{name} import main; sys.exit(main())",
            *overrides,
        ]
        subprocess.run(command, check=True, cwd=cwd, capture_output=True)

    run("train", "imports=mine.py", "task=costly", *TINY, "num_updates=1", "run_dir=run")
    run("train", "resume=../run", "num_updates=2", cwd=tmp_path / "elsewhere")
    run("evaluate", "../run", "price=0.1,0.2", cwd=tmp_path / "elsewhere")
    run("plot", "../run", "out=curve.png", cwd=tmp_path / "elsewhere")
    assert {"replay.html", "metrics.csv"} < {path.name for path in (tmp_path / "run").iterdir()}
    (evaluated,) = (tmp_path / "run").glob("eval-*.json")
    assert [x["task"]["price"] for x in json.loads(evaluated.read_text())["results"]] == [0.1, 0.2]
    (tmp_path / "mine.py").unlink()  # the run folder has a copy
    (tmp_path / "run").rename(tmp_path / "moved")
    run("train", "resume=moved", "num_updates=3")
    assert files.read_rows(tmp_path / "moved" / "metrics.csv")[-1]["update"] == 3
