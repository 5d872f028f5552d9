"""Sweeps and searches of tiny experiments, mostly through the command line program."""

import csv
import dataclasses
import json
import math
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from test_cli import TINY

from jaxswarm import config, files
from jaxswarm.cli import evaluate
from jaxswarm.cli import sweep as program
from jaxswarm.config import ConfigError
from jaxswarm.host import fit
from jaxswarm.host.run import Run
from jaxswarm.learners.on_policy import batch_size
from jaxswarm.studies import execution, search
from jaxswarm.studies import grid as sweep

OVERRIDES = [*TINY, "num_updates=4", "num_seeds=2"]
SWEPT = [*OVERRIDES, "learner.learning_rate=1e-4..1e-2:3log", "network.activation=tanh,relu", "render_every=1"]


def shortened(runs, num_updates):
    """Return the runs as if they had been interrupted after `num_updates` updates."""
    return [
        dataclasses.replace(run, settings=dataclasses.replace(run.settings, num_updates=num_updates)) for run in runs
    ]


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("learner.learning_rate=1e-4..1e-2:3 log", [1e-4, 1e-3, 1e-2]),
        ("learner.learning_rate=0.1..0.2:3", [0.1, 0.15, 0.2]),
        ("task.num_agents=5..20:4", [5, 10, 15, 20]),
        ("learner.learning_rate=1e-4,2e-4", [1e-4, 2e-4]),
    ],
)
def test_ranges_are_lists(word, values):
    key = word.partition("=")[0].split(".")
    found = [wanted[key[0]][key[1]] for wanted in sweep.expand([word])]
    np.testing.assert_allclose(found, values, rtol=1e-6)
    assert {type(x) for x in found} == {type(x) for x in values}


@pytest.mark.parametrize("word", ["learner.learning_rate=0..1:3log", "learner.learning_rate=a..b:3", "seed=1..5:1"])
def test_impossible_ranges_are_errors(word):
    with pytest.raises(ConfigError, match=r": must be low\.\.high:count"):
        sweep.expand([word])


def test_what_fixes_a_shape_has_a_program_of_its_own(tmp_path):
    trials = sweep.runs(sweep.expand(SWEPT), tmp_path)
    assert len(trials) == 6
    assert [len(together) for together in sweep.programs(trials)] == [3, 3]
    names = [trial.run_dir.name for trial in trials]
    assert names[0] == "0-learning_rate_0.0001-activation_tanh"
    assert len(set(names)) == 6


def test_equal_runs_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="differ only in"):
        sweep.runs(sweep.expand([*OVERRIDES, "task.side=50,50.0"]), tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
def test_a_sweep_is_interrupted_resumed_and_summarized(tmp_path, monkeypatch, capsys):
    sweep_dir, begun = tmp_path / "sweep", []
    real = execution.fit_runs

    def stops_in_the_second_program(runs, **options):
        begun.append(runs)
        return real(shortened(runs, 2) if len(begun) == 2 else runs, **options)

    with monkeypatch.context() as patch:
        patch.setattr(execution, "fit_runs", stops_in_the_second_program)
        assert program.main([*SWEPT, f"sweep_dir={sweep_dir}"]) == 0
    assert "stopped; resume with" in capsys.readouterr().out
    assert not (sweep_dir / "summary.csv").exists()
    assert program.main([f"resume={sweep_dir}"]) == 0
    with open(sweep_dir / "summary.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 6
    assert {line["seeds"] for line in table} == {"2"}
    medians = [float(line["median"]) for line in table]
    assert medians == sorted(medians, reverse=True)
    assert {line["metric"] for line in table} == {"eval/return"}
    assert "P(first is better)" in (sweep_dir / "summary.tex").read_text()
    assert (sweep_dir / "summary_improvement.csv").read_text().count("\n") == 1 + 6 * 5 // 2
    assert (sweep_dir / "curves.png").stat().st_size > 10_000
    folders = sorted(path for path in sweep_dir.iterdir() if path.is_dir())
    for folder in folders:
        rows = files.read_rows(folder / "metrics.csv")
        assert [(row["update"], row["seed"]) for row in rows] == [(u, s) for u in (0, 3, 4) for s in (5, 6)]
        assert {path.name for path in folder.glob("replay-*.html")} == {"replay-0.html", "replay-3.html"}
    before = {path: path.read_bytes() for path in folders[1].rglob("*") if path.is_file()}
    shutil.rmtree(folders[0])
    assert program.main([f"resume={sweep_dir}"]) == 0  # trains the missing run and leaves the others unchanged
    assert len(files.read_rows(folders[0] / "metrics.csv")) == 6
    assert {path: path.read_bytes() for path in folders[1].rglob("*") if path.is_file()} == before
    alone = config.load(folders[3] / "config.yaml")
    _, expected = fit.fit(config.build(alone), 4, seed=6, progress=False)
    found = [row["eval/return"] for row in files.read_rows(folders[3] / "metrics.csv") if row["seed"] == 6]
    np.testing.assert_allclose(found, [row["eval/return"] for row in expected], rtol=1e-5)
    assert evaluate.main([str(folders[0]), "episodes=2"]) == 0
    assert "of each of 2 seeds" in capsys.readouterr().out


def test_a_seed_that_diverges_counts_with_its_worst():
    rows = [{"update": u, "seed": 0, "eval/return": float(u)} for u in (0, 10, 20)]
    assert search.value(rows, [0], 3) == 10
    rows += [{"update": 0, "seed": 1, "eval/return": -6.0}]
    assert search.value(rows, [0, 1], 3) == 2
    assert search.value(rows, [0, 1, 2], 3) == (10 - 6 - 6) / 3
    assert search.value(rows[-2:], [0, 1], 3) == (20 * 3 - 6 * 3) / 6  # all seeds have diverged
    assert math.isnan(search.value([], [0], 3))


def test_what_diverged_counts_as_evaluated_to_its_end(tmp_path, monkeypatch):
    (run,) = sweep.runs(sweep.expand([*OVERRIDES, "num_updates=7"]), tmp_path)
    assert run.num_evaluations == 4  # before updates 0, 3, 6, and after the last
    rows = [[{"update": 0, "seed": 1, "eval/return": -6.0}]]

    def diverge(*_, **__):
        raise fit.DivergedError("training stopped", rows)

    monkeypatch.setattr(execution, "fit_runs", diverge)
    assert execution.train([run], progress=False) == (True, rows)


def test_what_the_command_line_says_is_not_searched():
    optuna = pytest.importorskip("optuna")
    pairs = config.parse(["encoder=[64]", "batch_size=512", "network=medium"])
    space = search.load_space("thesis", config.compose_pairs(pairs))
    suggested = search.suggest(optuna.create_study().ask(), space, pairs)
    assert (suggested["network"]["encoder"], suggested["learner"]["batch_size"]) == ([64], 512)


def test_processes_that_search_together_draw_different_settings(tmp_path):
    pytest.importorskip("optuna")
    studies = [search.open_study(str(tmp_path / "journal.log")) for _ in range(2)]
    widths = [search.ask(study, seed=0).suggest_int("width", 1, 10**6) for study in (*studies, *studies)]
    assert len(set(widths)) == 4
    again = search.ask(search.open_study(str(tmp_path / "other.log")), seed=0)
    assert again.suggest_int("width", 1, 10**6) == widths[0]


def test_runs_with_seeds_that_diverged_come_last():
    wanted = config.compose(OVERRIDES)

    def trial(number):
        return Run.from_config(wanted, Path(f"run{number}"))

    rows = [
        [{"update": 4, "seed": s, "eval/return": x} for s, x in enumerate(xs)] for xs in ([9.0], [1.0, 2.0], [3.0, 4.0])
    ]
    summary = sweep.summary([trial(i) for i in range(3)], rows)
    assert [line["run"] for line in summary.lines] == ["run2", "run1", "run0"]
    assert [(line["seeds"], line["diverged"]) for line in summary.lines] == [(2, 0), (2, 0), (1, 1)]
    assert summary.comparison.explain() == ""


def test_runs_with_other_visibility_radii_are_sorted_by_a_metric_that_does_not_depend_on_them():
    runs = [
        Run.from_config(config.compose([*OVERRIDES, f"visibility_radius={radius}"]), Path(f"radius{radius}"))
        for radius in (10, 50)
    ]
    values = {"eval/return": (-9.0, -1.0), "eval/final_center_distance": (2.0, 4.0)}
    rows = [[{"update": 4, "seed": s} | {name: x[i] for name, x in values.items()} for s in (0, 1)] for i in (0, 1)]
    summary = sweep.summary(runs, rows)
    assert "task.visibility_radius" in summary.comparison.explain()
    assert [(line["run"], line["metric"], line["median"]) for line in summary.lines] == [
        ("radius10", "eval/final_center_distance", 2.0),
        ("radius50", "eval/final_center_distance", 4.0),
    ]
    assert summary.lines[1]["p_first"] == 1.0
    (pair,) = summary.improvements
    assert (pair["better"], pair["than"], pair["probability"]) == ("radius10", "radius50", 1.0)


@pytest.mark.parametrize("where", ["a_file", "/proc/nowhere"])
def test_folders_that_cannot_be_written_are_named(where, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_file").write_text("")
    assert program.main(["learner.discount=0.9,0.8", f"sweep_dir={where}"]) == 2
    assert where in capsys.readouterr().err
    assert program.main(["num_updates=1,2", "sweep_dir=new"]) == 2
    assert "num_updates: must have one value in a sweep, got 1,2" in capsys.readouterr().err


SPACE = """
parameters:
  learner.learning_rate: {low: 1e-4, high: 1e-2, log: true}
  learner.batch_size: {low: 5, high: 30}
"""


@pytest.mark.slow
def test_the_space_of_the_thesis_gives_configs_for_each_aggregator():
    optuna = pytest.importorskip("optuna")
    for name in ("mean", "bayesian", "attentive"):
        pairs = config.parse([f"aggregator={name}", "task=pursuit"])
        space = search.load_space("thesis", config.compose_pairs(pairs))
        for seed in range(3):
            study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed))
            experiment = config.build(search.suggest(study.ask(), space, pairs))
            assert 1 <= len(experiment.network.encoder) <= 3
            sizes = experiment.learner, experiment.agent_steps_per_update, experiment.task.num_agents
            assert 400 < batch_size(*sizes) < 12_000


def test_the_space_of_the_thesis_holds_what_it_found():
    optuna = pytest.importorskip("optuna")
    found = {
        **{"network.encoder.layers": 1, "network.encoder.0": 146, "network.encoder.last": 120},
        **{"network.decoder.layers": 2, "network.decoder.0": 19, "network.decoder.1": 177, "network.decoder.last": 162},
        **{"network.activation": "tanh", "network.latent_space": "separate", "learner.batch_size": 1000},
    }
    pairs = config.parse(["experiment=rendezvous_thesis"])
    space = search.load_space("thesis", config.compose_pairs(pairs))
    suggested = search.suggest(optuna.trial.FixedTrial(found), space, pairs)
    assert suggested == config.compose(["experiment=rendezvous_thesis", "network=rendezvous_opt"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("parameters: {learner.learning_rate: {low: 2, high: 1}}", "must be a list, or numbers"),
        ("parameters: {learner.learning_rate: {lowest: 1}}", "must be a list, or numbers"),
        ("parameters: {learner.learning_rate: {low: a, high: 2}}", "must be a list, or numbers"),
        ("parameters: {learner.learning_rate: {low: 0, high: 1, log: true}}", "must be a list, or numbers"),
        ("parameters: {network.encoder: {layers: 2, low: 1, high: 3}}", "must be a list, or numbers"),
        ("parameters: {network.encoder: {layers: [1, 2], low: 1, high: 3, last: 5}}", "must be a list, or numbers"),
        ("parameters: [1]", "must have the form"),
        ("aggregator: {mean: [1]}", "must have the form"),
        ("params: {}", "keys must be parameters and aggregator, got 'params'"),
    ],
)
def test_impossible_spaces_are_errors(tmp_path, text, message):
    (tmp_path / "space.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        search.load_space(str(tmp_path / "space.yaml"), {"aggregator": {"name": "mean"}})
    with pytest.raises(ConfigError, match="search: must be one of thesis"):
        search.load_space("unknown", {"aggregator": {"name": "mean"}})


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
def test_a_search_shares_its_storage_and_continues_what_was_cut_off(tmp_path, monkeypatch, capsys):
    pytest.importorskip("optuna")
    (tmp_path / "space.yaml").write_text(SPACE)
    storage = tmp_path / "journal.log"
    overrides = [*OVERRIDES, f"search={tmp_path / 'space.yaml'}", "trials=3", f"storage={storage}"]
    overrides = [word for word in overrides if "batch_size" not in word]
    real = execution.fit_runs
    with monkeypatch.context() as patch:
        patch.setattr(execution, "fit_runs", lambda runs, **options: real(shortened(runs, 2), **options))
        assert program.main([*overrides, f"sweep_dir={tmp_path / 'one'}"]) == 0
    assert "stopped; resume with" in capsys.readouterr().out
    assert program.main([*overrides, f"sweep_dir={tmp_path / 'two'}"]) == 0  # another machine resumes it
    study = search.open_study(str(storage))
    complete = [trial for trial in study.trials if trial.state.name == "COMPLETE"]
    assert len(complete) == 3
    first = next(trial for trial in complete if Path(trial.user_attrs["run_dir"]).parent.name == "one")
    rows = files.read_rows(Path(first.user_attrs["run_dir"]) / "metrics.csv")
    assert first.value == pytest.approx(np.mean([row["eval/return"] for row in rows]), rel=1e-6)
    assert {row["update"] for row in rows} == {0, 3, 4}
    assert json.loads((tmp_path / "two" / "sweep.json").read_text())["options"]["trials"] == "3"


def test_wrong_words_are_errors(tmp_path, capsys):
    assert program.main(["trials=3", "learner.learning_rate=1,2"]) == 2
    assert "trials: must be used with search=NAME" in capsys.readouterr().err
    assert program.main([f"resume={tmp_path}"]) == 2
    assert "not the folder of a sweep" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text",
    [
        *("", "null", "3", "[]", '{"options": {}}', '{"words": 3}'),
        '{"options": {}, "overrides": [1, 2]}',
        '{"options": 1, "overrides": []}',
        '{"options": {"search": 1}, "overrides": []}',
        '{"options": {"out": "x"}, "overrides": []}',
    ],
)
def test_a_damaged_plan_is_refused(text, tmp_path, capsys):
    (tmp_path / "sweep.json").write_text(text)
    assert program.main([f"resume={tmp_path}"]) == 2
    err = capsys.readouterr().err
    assert "is not the folder of a sweep: it has no valid sweep.json" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["seed=1,2"], "seed: must have one value in a sweep, got 1,2; train several seeds with num_seeds=N"),
        (["num_updates=1..3:3"], "num_updates: must have one value in a sweep, got 1,2,3"),
        (["num_envs=1..9:1000000"], "with 2 <= count <= 1000"),
        (["task.side=1..1e400:3"], "task.side: must be low..high:count"),
        (["sweep_dir=[]"], "must not contain [, ]"),
        (["sweep_dir=[]", "search=thesis"], "must not contain [, ]"),
        (["num_envs=2,4", "init_from=nowhere"], "init_from: must be a run folder"),
        (["num_envs=glob(*)"], "override: must be key=value"),
        (["num_agents=2,100000"], "task.num_agents: must be small enough for the memory, got 100000"),
        (["search=thesis", "num_agents=100000"], "task.num_agents: must be small enough for the memory, got 100000"),
    ],
)
def test_a_refused_sweep_writes_nothing(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert program.main(words) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_torn_line_of_a_journal_is_named_with_its_repair(tmp_path, monkeypatch):
    pytest.importorskip("optuna")
    monkeypatch.setattr(search, "WRITE_SECONDS", 0.0)
    storage = tmp_path / "a journal.log"
    search.open_study(str(storage))
    complete = storage.read_bytes()
    number = complete.count(b"\n") + 1
    for torn in (b'{"op_code": 4, "wor', b'{"op_code": 4, "wor{"op_code": 4}\n'):
        storage.write_bytes(complete + torn)
        with pytest.raises(ConfigError) as caught:
            search.open_study(str(storage))
        message = str(caught.value)
        assert f"storage: line {number} of {storage} must be complete JSON" in message
        assert message.endswith(f"sed -i {number}d '{storage}'")
    subprocess.run(message.partition("with: ")[2], shell=True, check=True)
    assert storage.read_bytes() == complete
    search.open_study(str(storage))


def test_a_search_space_of_0_1_is_translated(tmp_path, capsys):
    (tmp_path / "space.yaml").write_text(
        "parameters: {learner.max_gradient_norm: [0.5], num_worlds: [2, 4], learner.learning_rate: [1]}\n"
        "aggregator: {mean: {learner.minibatch: [worlds, agents]}}\n"
    )
    space = search.load_space(str(tmp_path / "space.yaml"), config.compose())
    assert space == {
        "learner.max_grad_norm": [0.5],
        "num_envs": [2, 4],
        "learner.learning_rate": [1],
        "learner.sampling_unit": ["envs", "agents"],
    }
    err = capsys.readouterr().err
    assert "was written for jaxswarm 0.1; its keys were translated: learner.max_gradient_norm ->" in err
