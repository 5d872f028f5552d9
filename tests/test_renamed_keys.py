import json
import shutil
from pathlib import Path
from unittest import mock

import jax
import pytest

import jaxswarm
from jaxswarm import LEARNERS, files
from jaxswarm import config as configs
from jaxswarm.analysis import run_folders
from jaxswarm.cli import evaluate, plot, train
from jaxswarm.config import composition, renamed
from jaxswarm.types import pytree

RUN = Path(__file__).parent / "runs_of_0_1" / "small"
OVERRIDES = [
    *("task.num_agents=3", "task.episode_length=5", "num_envs=2", "num_steps=4", "num_updates=4"),
    *("learner=trl", "learner.batch_size=12", "learner.sampling_unit=envs", "num_eval_envs=2", "eval_every=3"),
    *("network.encoder=[4]", "network.decoder=[4]"),
]
RETURNS = {"best": -1.3421628, "last": -1.3420900}  # of `jaxswarm-eval small episodes=4` of version 0.1


@pytest.fixture
def run_dir(tmp_path):
    return shutil.copytree(RUN, tmp_path / "small")


def old_name(key):
    return {new: old for old, new in renamed.KEYS.items()}.get(key, key)


def test_a_config_of_0_1_is_translated_and_reported_once(monkeypatch, capsys):
    monkeypatch.setattr(composition, "_translated_files", set())
    assert configs.load(RUN / "config.yaml") == configs.compose(OVERRIDES)
    assert configs.read(RUN / "config.yaml")["learner"]["sampling_unit"] == "envs"
    captured = capsys.readouterr()
    assert captured.err.startswith(f"{RUN / 'config.yaml'} was written by jaxswarm 0.1; its keys were translated: ")
    assert captured.err.count("\n") == 1
    for change in (
        "num_worlds -> num_envs",
        "learner.coefficient -> learner.regression_coefficient",
        "learner.minibatch=worlds -> learner.sampling_unit=envs",
        "task.relative_velocity=normalised -> task.relative_velocity=normalized",
    ):
        assert change in captured.err


@pytest.mark.parametrize("overrides", [[], ["learner=trl"], ["sampling_unit=agents"], ["task=pursuit"]])
def test_translation_changes_names_only(overrides):
    config = configs.compose(overrides)
    old = {
        old_name(head): {old_name(f"{head}.{name}").removeprefix(f"{head}."): y for name, y in x.items()}
        if isinstance(x, dict)
        else x
        for head, x in config.items()
    }
    assert old != config
    translated, changes = renamed.translate(old, lambda part, name: False)
    assert translated == config
    assert len(changes) == 5 + (overrides == ["learner=trl"])
    assert renamed.translate(config, lambda part, name: False) == (config, [])


@pytest.mark.parametrize("old", renamed.KEYS)
@pytest.mark.parametrize("has_prefix", [True, False])
def test_an_old_key_is_refused_with_its_new_name(old, has_prefix, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    new = renamed.KEYS[old]
    if not has_prefix:
        old, new = old.rpartition(".")[2], new.rpartition(".")[2]
    assert train.main(["learner=trl", f"{old}=3"]) == 2
    assert capsys.readouterr().err == f"error: {old}: renamed to {new}\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("key", "value"), renamed.VALUES)
def test_an_old_value_is_refused_with_its_new_name(key, value, capsys):
    assert train.main([f"{key}={value}"]) == 2
    assert capsys.readouterr().err == f"error: {key}: {value} was renamed to {renamed.VALUES[key, value]}\n"


def test_fields_of_a_users_learner_keep_their_names(tmp_path, capsys):
    @pytree
    class Own(LEARNERS["ppo"]):
        coefficient: float = 2.0

    with mock.patch.dict(LEARNERS, own=Own):
        config = configs.compose() | {"learner": {"name": "own", "coefficient": 3.0}}
        (tmp_path / "config.yaml").write_text(configs.dump(config))
        loaded = configs.load(tmp_path / "config.yaml")
        assert loaded["learner"]["coefficient"] == 3.0
        assert configs.override(loaded, [("coefficient", 4)])["learner"]["coefficient"] == 4.0
    assert not capsys.readouterr().err


def test_runs_of_0_1_are_in_one_group_with_runs_of_today(tmp_path, run_dir):
    today = shutil.copytree(run_dir, tmp_path / "today")
    (today / "config.yaml").write_text(configs.dump(configs.compose(OVERRIDES)))
    groups = run_folders.group([run_folders.read(path) for path in (run_dir, today)])
    assert [len(folders) for folders in groups.values()] == [2]


def test_a_run_of_0_1_is_loaded():
    experiment, params = jaxswarm.load(RUN)
    assert jax.tree.structure(experiment) == jax.tree.structure(configs.build(configs.compose(OVERRIDES)))
    state = experiment.task.reset(jax.random.key(0))
    policy = experiment.network.apply(params, experiment.task.observe(state), method="policy")
    assert policy.stddev()[0].tolist() == pytest.approx([0.99754459, 0.98471600], abs=1e-6)


@pytest.mark.parametrize("checkpoint", RETURNS)
def test_a_run_of_0_1_evaluates_to_the_recorded_return(run_dir, checkpoint):
    assert evaluate.main([str(run_dir), "episodes=4", f"checkpoint={checkpoint}"]) == 0
    (path,) = run_dir.glob("eval-*.json")
    metrics = json.loads(path.read_text())["results"][0]["metrics"]
    assert metrics["return"] == pytest.approx(RETURNS[checkpoint], abs=1e-5)


def test_a_run_of_0_1_is_plotted(run_dir, tmp_path):
    assert plot.main([str(run_dir), f"out={tmp_path / 'curve.png'}"]) == 0
    assert (tmp_path / "curve.png").stat().st_size > 0


@pytest.mark.slow
def test_a_run_of_0_1_resumes_with_the_recorded_returns(few_optimizations, run_dir):
    assert train.main([f"resume={run_dir}", "num_updates=7"]) == 0
    rows = files.read_rows(run_dir / "metrics.csv")
    assert [row["update"] for row in rows] == [0, 3, 6, 7]
    assert [row["eval/return"] for row in rows[-2:]] == pytest.approx([-1.438514, -1.9802207], abs=1e-4)
    assert "num_envs: 2" in (run_dir / "config.yaml").read_text()


@pytest.mark.slow
def test_a_run_of_0_1_is_a_warm_start(few_optimizations, tmp_path):
    assert train.main([*OVERRIDES, "num_updates=1", f"init_from={RUN}", f"run_dir={tmp_path / 'run'}"]) == 0
    experiment, params = jaxswarm.load(RUN)
    start = jaxswarm.init(experiment, jax.random.key(0))
    start = start.replace(learner=start.learner.replace(params=params))
    expected = float(jaxswarm.evaluate(experiment, start)["eval/return"])
    assert files.read_rows(tmp_path / "run" / "metrics.csv")[0]["eval/return"] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("num_worlds=2,4", "num_envs=2,4"),
        ("learner.minibatch=agents,worlds", "learner.sampling_unit=agents,envs"),
        ("minibatch=worlds", "sampling_unit=envs"),
        ("task.relative_velocity=normalised", "task.relative_velocity=normalized"),
        ("seed=3", "seed=3"),
    ],
)
def test_overrides_of_sweeps_are_translated(old, new):
    assert renamed.translate_override(old) == new
