"""Runs of one tiny experiment, compiled once: however they are interrupted, they end in the same bits."""

import contextlib
import csv
import shutil
import signal

import jax
import numpy as np
import pytest

import jaxswarm
from jaxswarm import config, files
from jaxswarm.config import ConfigError
from jaxswarm.host import batch_recorder, checkpoint, ensemble, recorder
from jaxswarm.host import fit as fitting
from jaxswarm.host.fit import DivergedError, fit, fit_runs
from jaxswarm.host.metrics_log import MetricsLog
from jaxswarm.host.recorder import Recorder
from jaxswarm.host.run import Run, locked, split_started
from jaxswarm.tasks import Rendezvous
from jaxswarm.types import pytree

OVERRIDES = (
    "task.num_agents=3 task.episode_length=5 num_envs=2 num_steps=4 learner.batch_size=12 num_eval_envs=2 eval_every=3 "
    "network.encoder=[4] network.decoder=[4]"
)
EXPERIMENT = config.build(config.compose(OVERRIDES.split()))
NUM_UPDATES = 8
OPTIONS = {"progress": False, "checkpoint_seconds": 0.0}


class Killed(BaseException):
    """A stand-in for a kill, which no handler catches."""


def assert_same_state(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        if jax.numpy.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)  # noqa: PLW2901
        np.testing.assert_array_equal(a, b)


def table(run_dir):
    """Return the rows of metrics.csv without the time."""
    with open(run_dir / "metrics.csv", newline="") as file:
        return [{name: x for name, x in row.items() if name != "wall_seconds"} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("run") / "undisturbed"
    return *fit(EXPERIMENT, NUM_UPDATES, seed=3, run_dir=run_dir, **OPTIONS), run_dir


def assert_resumes_to_the_same(run_dir, undisturbed):
    state, rows = fit(EXPERIMENT, NUM_UPDATES, seed=3, run_dir=run_dir, resume=True, **OPTIONS)
    assert_same_state(state, undisturbed[0])
    assert table(run_dir) == table(undisturbed[2])
    assert [row["update"] for row in rows] == [0, 3, 6, 8]


def test_chunks_are_the_single_program_bit_by_bit(undisturbed):
    state, rows, _ = undisturbed
    start = jaxswarm.init(EXPERIMENT, jax.random.key(3))
    train = jaxswarm.train.lower(EXPERIMENT, start, NUM_UPDATES).compile(ensemble.compiler_options())
    expected, metrics = train(EXPERIMENT, start)
    assert_same_state(state, expected)
    metrics = jax.device_get(metrics)
    assert metrics.pop("is_finite").all()
    assert [row["update"] for row in rows] == [0, 3, 6, 8]
    assert [row["agent_steps"] for row in rows] == [0, 72, 144, 192]
    assert [row["env_steps"] for row in rows] == [row["agent_steps"] // EXPERIMENT.task.num_agents for row in rows]
    for name, values in metrics.items():
        found = [row[name] for row in rows]
        if name.startswith("eval/"):
            np.testing.assert_array_equal(np.float32(found[:3]), values[[0, 3, 6]])
        else:
            means = [np.nan, *(np.mean(x[~np.isnan(x)].astype(float)) for x in (values[:3], values[3:6], values[6:]))]
            np.testing.assert_allclose(found, means, rtol=1e-12)


def test_evaluations_without_checkpoints_are_not_trained_over(undisturbed, tmp_path):
    shutil.copytree(undisturbed[2], tmp_path / "kept", ignore=shutil.ignore_patterns("checkpoints"))
    with pytest.raises(FileExistsError, match="no checkpoints"):
        fit(EXPERIMENT, NUM_UPDATES, seed=3, run_dir=tmp_path / "kept", resume=True, **OPTIONS)
    assert table(tmp_path / "kept") == table(undisturbed[2])


@pytest.mark.parametrize(
    ("changes", "seed", "message"),
    [
        ({"num_envs": 4}, 3, "num_envs is 2 there, and 4 here"),
        (
            {"learner": EXPERIMENT.learner.replace(learning_rate=1.0)},
            3,
            r"learner.learning_rate is \S+ there, and 1.0 here",
        ),
        ({}, 4, "seed is 3 there, and 4 here"),
    ],
)
def test_another_run_is_not_resumed(undisturbed, tmp_path, changes, seed, message):
    shutil.copytree(undisturbed[2], tmp_path / "run")
    before = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    with pytest.raises(FileExistsError, match=f"holds another run: {message}"):
        fit(EXPERIMENT.replace(**changes), 10, seed=seed, run_dir=tmp_path / "run", resume=True, **OPTIONS)
    assert {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()} == before


def test_a_run_is_not_started_anew_because_one_beside_it_is_new(undisturbed, tmp_path):
    shutil.copytree(undisturbed[2], tmp_path / "begun")
    settings = config.RunSettings(seed=3, num_updates=NUM_UPDATES)
    runs = [Run(EXPERIMENT, settings, tmp_path / name) for name in ("begun", "new")]
    with pytest.raises(FileExistsError, match=r"begun holds a run and .*new does not"):
        fit_runs(runs, resume=True, progress=False)
    assert table(tmp_path / "begun") == table(undisturbed[2])
    assert split_started([tmp_path / "new", tmp_path / "newer"]) == ([tmp_path / "new", tmp_path / "newer"], [])
    (tmp_path / "new").mkdir(exist_ok=True)
    shutil.copy(tmp_path / "begun" / "metrics.csv", tmp_path / "new")  # killed between the first saves of the two
    assert split_started([tmp_path / "begun", tmp_path / "new"]) == ([tmp_path / "begun", tmp_path / "new"], [])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_updates": 0}, "num_updates: .*, got 0"),
        ({"num_seeds": 0}, "num_seeds: .*, got 0"),
        ({"seed": -1}, "seed: .*, got -1"),
        ({"seed": 2**32}, "seed: .*, got 4294967296"),
        ({"keep_checkpoints": 0}, "keep_checkpoints: .*, got 0"),
        ({"checkpoint_seconds": -1.0}, "checkpoint_seconds: .*, got -1.0"),
        ({"log_to": ("paper",)}, "loggers: must be a list of tensorboard, wandb, got 'paper'"),
    ],
)
@pytest.mark.filterwarnings("ignore:.* gets no config")
def test_impossible_settings_are_named(tmp_path, options, message):
    with pytest.raises(ConfigError, match=message):
        fit(EXPERIMENT, **{"num_updates": 3} | options, run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_run_folder_without_a_config_is_announced(tmp_path):
    class Own(jaxswarm.ActorCritic):
        """A network that no config describes."""

    with pytest.warns(UserWarning, match="run gets no config"):
        fit(EXPERIMENT.replace(network=Own((4,), (4,))), 1, run_dir=tmp_path / "run", progress=False)


def test_training_begins_with_a_policy_if_there_is_one(undisturbed):
    params = undisturbed[0].learner.params
    _, rows = fit(EXPERIMENT, 1, seed=9, num_seeds=2, init_params=params, **OPTIONS)
    for seed, row in zip((9, 10), rows[:2], strict=True):
        start = jaxswarm.init(EXPERIMENT, jax.random.key(seed))
        start = start.replace(learner=start.learner.replace(params=params))
        assert row["eval/return"] == pytest.approx(float(jaxswarm.evaluate(EXPERIMENT, start)["eval/return"]), abs=1e-5)
    assert len({row["eval/return"] for row in rows}) == 4


def test_a_policy_of_another_network_is_nothing_to_begin_with(undisturbed, tmp_path):
    other = EXPERIMENT.replace(network=jaxswarm.ActorCritic((5,), (4,)))
    with pytest.raises(ConfigError, match="init_params: must have the parameter shapes of this network"):
        fit(other, 1, init_params=undisturbed[0].learner.params, run_dir=tmp_path / "run", **OPTIONS)
    assert not (tmp_path / "run").exists()


def test_the_last_row_evaluates_the_final_policy(undisturbed):
    state, rows, _ = undisturbed
    expected = jaxswarm.evaluate(EXPERIMENT, state)
    np.testing.assert_allclose(rows[-1]["eval/return"], expected["eval/return"], rtol=1e-5)


def test_the_run_folder_is_complete(undisturbed):
    run_dir = undisturbed[2]
    names = {"config.yaml", "manifest.json", "metrics.csv", "checkpoints", "curve.png"}
    assert {path.name for path in run_dir.iterdir()} == names
    seconds = [row["wall_seconds"] for row in files.read_rows(run_dir / "metrics.csv")]
    assert seconds == sorted(seconds)
    best = max(undisturbed[1], key=lambda row: row["eval/return"])
    restored = checkpoint.restore(run_dir / "checkpoints", ensemble.abstract_state(EXPERIMENT), "best")
    assert (restored.update, np.float32(restored.score)) == (best["update"], np.float32(best["eval/return"]))


def test_what_python_trained_is_loaded_like_any_run(undisturbed):
    state, _, run_dir = undisturbed
    experiment, params = jaxswarm.load(run_dir, "last", seed=3)
    assert jax.tree.structure(experiment) == jax.tree.structure(EXPERIMENT)
    assert_same_state(params, state.learner.params)


def test_a_checkpoint_of_another_network_is_not_resumed(undisturbed, tmp_path):
    run_dir = shutil.copytree(undisturbed[2], tmp_path / "run")
    (run_dir / "config.yaml").unlink()  # it would show the difference first
    other = EXPERIMENT.replace(network=jaxswarm.ActorCritic(encoder=(5,), decoder=(4,)))
    with pytest.raises(checkpoint.CheckpointError):
        fit(other, NUM_UPDATES + 1, seed=3, run_dir=run_dir, resume=True, **OPTIONS)
    assert not (run_dir / "config.yaml").exists()


def test_two_processes_do_not_train_into_one_folder(tmp_path):
    """Locks belong to open files, so one process can play both roles."""
    with locked(tmp_path / "run"):
        with pytest.raises(ConfigError, match="run is being trained by another process"):
            fit(EXPERIMENT, NUM_UPDATES, run_dir=tmp_path / "run", **OPTIONS)
        assert not list((tmp_path / "run").iterdir())
    with locked(tmp_path / "run"):
        pass  # the lock is free again


def test_a_folder_that_another_process_filled_meanwhile_is_not_overwritten(undisturbed, tmp_path, monkeypatch):
    run_dir = tmp_path / "run"

    @contextlib.contextmanager
    def locked_late(path):
        shutil.copytree(undisturbed[2], path)
        yield

    monkeypatch.setattr(fitting, "locked", locked_late)
    with pytest.raises(FileExistsError, match="already holds a run"):
        fit(EXPERIMENT, NUM_UPDATES, run_dir=run_dir, **OPTIONS)
    assert table(run_dir) == table(undisturbed[2])


def test_chunks_of_any_length_give_the_same(undisturbed, tmp_path, monkeypatch):
    monkeypatch.setattr(batch_recorder, "SECONDS_PER_CHUNK", 0.0)
    state, _ = fit(EXPERIMENT, NUM_UPDATES, seed=3, run_dir=tmp_path / "run", **OPTIONS)
    assert_same_state(state, undisturbed[0])
    assert table(tmp_path / "run") == table(undisturbed[2])


def test_without_a_folder_nothing_is_written(undisturbed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    state, rows = fit(EXPERIMENT, NUM_UPDATES, seed=3, progress=False)
    assert_same_state(state, undisturbed[0])
    assert [row["eval/return"] for row in rows] == [row["eval/return"] for row in undisturbed[1]]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("first", [2, 3, 5])
def test_a_run_that_is_made_longer_is_the_long_run(undisturbed, tmp_path, first):
    fit(EXPERIMENT, first, seed=3, run_dir=tmp_path / "run", **OPTIONS)
    assert_resumes_to_the_same(tmp_path / "run", undisturbed)


@pytest.mark.parametrize("died_at", range(8))
@pytest.mark.parametrize("checkpoint_seconds", [0.0, 1e9])
def test_a_killed_run_resumes_to_the_same_end(undisturbed, tmp_path, monkeypatch, died_at, checkpoint_seconds):
    texts_written = []

    def append_half_a_row(path, text):
        if len(texts_written) == died_at:
            append_text(path, text[: len(text) // 2])
            raise Killed
        texts_written.append(append_text(path, text))

    append_text, run_dir = files.append_text, tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(files, "append_text", append_half_a_row)
        patch.setattr(Recorder, "close", lambda self: self._checkpoints and self._checkpoints.close())
        options = OPTIONS | {"checkpoint_seconds": checkpoint_seconds}
        with pytest.raises(Killed):
            fit(EXPERIMENT, NUM_UPDATES, seed=3, run_dir=run_dir, **options)
    assert_resumes_to_the_same(run_dir, undisturbed)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_after_a_checkpoint(undisturbed, tmp_path, monkeypatch, number):
    run_dir, handlers = tmp_path / "run", [signal.getsignal(number)]
    append = MetricsLog.append

    def interrupted(log, rows):
        append(log, rows)
        if rows[0]["update"] == 0:
            signal.raise_signal(number)

    with monkeypatch.context() as patch:
        patch.setattr(MetricsLog, "append", interrupted)
        state, _ = fit(EXPERIMENT, NUM_UPDATES, seed=3, run_dir=run_dir, **(OPTIONS | {"checkpoint_seconds": 1e9}))
    assert 0 < int(state.update) < NUM_UPDATES
    assert signal.getsignal(number) == handlers[0]
    restored = checkpoint.restore(run_dir / "checkpoints", ensemble.abstract_state(EXPERIMENT))
    assert restored.update == int(state.update)
    assert_resumes_to_the_same(run_dir, undisturbed)


def test_a_damaged_checkpoint_costs_updates_and_no_bits(undisturbed, tmp_path, capsys):
    run_dir = shutil.copytree(undisturbed[2], tmp_path / "run")
    for file in (run_dir / "checkpoints" / "8" / "state").rglob("d/*"):
        file.write_bytes(b"")
    assert_resumes_to_the_same(run_dir, undisturbed)
    assert "8 is damaged" in capsys.readouterr().err


def test_a_finished_run_is_left_alone(undisturbed):
    state, rows, run_dir = undisturbed
    before = (run_dir / "metrics.csv").read_bytes()
    again = fit(EXPERIMENT, NUM_UPDATES, seed=3, run_dir=run_dir, resume=True, **OPTIONS)
    assert_same_state(again[0], state)
    assert [row["update"] for row in again[1]] == [row["update"] for row in rows]
    assert (run_dir / "metrics.csv").read_bytes() == before


def test_another_run_is_never_overwritten(undisturbed):
    with pytest.raises(FileExistsError, match="resume"):
        fit(EXPERIMENT, NUM_UPDATES, run_dir=undisturbed[2], **OPTIONS)


def test_numbers_that_are_not_finite_stop_the_run_and_leave_the_last_good_checkpoint(tmp_path):
    run_dir = tmp_path / "run"
    fit(EXPERIMENT, 3, run_dir=run_dir, **OPTIONS)
    diverging = EXPERIMENT.replace(learner=EXPERIMENT.learner.replace(learning_rate=1e10))
    with pytest.raises(DivergedError, match=r"is (nan|inf|not finite) at update \d"):
        fit(diverging, NUM_UPDATES, run_dir=run_dir, resume=True, force=True, **OPTIONS)
    restored = checkpoint.restore(run_dir / "checkpoints", ensemble.abstract_state(EXPERIMENT))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(restored.train_state.learner.params))


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
def test_the_curve_grows_during_training(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "SECONDS_PER_CURVE", 0.0)
    curve, sizes = tmp_path / "run" / "curve.png", []
    fit(
        EXPERIMENT,
        NUM_UPDATES,
        run_dir=tmp_path / "run",
        on_evaluation=lambda *_: sizes.append(curve.stat().st_size),
        **OPTIONS,
    )
    assert len(set(sizes)) == 3


@pytree
class Unrewarded(Rendezvous):
    """A rendezvous whose reward is NaN."""

    def step(self, key, state, action):
        state, outcome = super().step(key, state, action)
        return state, outcome.replace(reward=outcome.reward * jax.numpy.nan)


@pytest.mark.slow
def test_a_return_that_is_no_number_stops_the_run_and_is_named():
    experiment = EXPERIMENT.replace(task=Unrewarded(num_agents=3, episode_length=5))
    with pytest.raises(DivergedError, match="eval/return is nan at update 0"):
        fit(experiment, NUM_UPDATES, progress=False)


def test_a_plot_that_fails_is_one_warning(tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise OSError("no fonts")

    monkeypatch.setattr(recorder.training_curve, "draw_curve", fail)
    for name in ("first", "second"):
        fit(EXPERIMENT, 1, run_dir=tmp_path / name, **OPTIONS)
    assert capsys.readouterr().err == "warning: no curve.png: OSError: no fonts\n"


def test_a_run_that_fails_before_its_first_update_leaves_no_folder(tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("no program")

    monkeypatch.setattr(ensemble, "compile_batch", fail)
    with pytest.raises(RuntimeError, match="no program"):
        fit(EXPERIMENT, 1, run_dir=tmp_path / "run", **OPTIONS)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["run[1]", "a\\b"])
def test_folders_that_checkpoints_do_not_support_are_refused(tmp_path, name):
    with pytest.raises(ConfigError, match="run_dir: must not contain"):
        fit(EXPERIMENT, 1, run_dir=tmp_path / name, **OPTIONS)
    assert not list(tmp_path.iterdir())


def test_damaged_evaluations_are_restored(undisturbed, tmp_path, capsys):
    run_dir = shutil.copytree(undisturbed[2], tmp_path / "run")
    (run_dir / "metrics.csv").write_text("update,seed\n1,x\n")
    assert_resumes_to_the_same(run_dir, undisturbed)
    assert "metrics.csv has been changed or damaged" in capsys.readouterr().err
