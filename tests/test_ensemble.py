"""Vectorized seeds, numbers and devices: the result of a run does not depend on the runs beside it."""

import json
import math
import os
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxswarm
from jaxswarm import config, files
from jaxswarm.host import checkpoint, ensemble
from jaxswarm.host.ensemble import abstract_state
from jaxswarm.host.fit import DivergedError, fit, fit_runs
from jaxswarm.host.run import Run

OVERRIDES = (
    "task.num_agents=3 task.episode_length=5 num_envs=4 num_steps=4 learner.batch_size=24 num_eval_envs=2 eval_every=3 "
    "network.encoder=[4] network.decoder=[4]"
)
EXPERIMENT = config.build(config.compose(OVERRIDES.split()))
DIVERGING = EXPERIMENT.replace(learner=EXPERIMENT.learner.replace(learning_rate=1e10))
OPTIONS = {"progress": False, "checkpoint_seconds": 0.0}


def assert_same(found, expected, atol=0.0):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)  # noqa: PLW2901
        np.testing.assert_allclose(a, b, atol=atol, rtol=0)


def one(states, index):
    return jax.tree.map(lambda x: x[index], states)


@pytest.fixture(scope="module")
def three_seeds(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("runs") / "three"
    return *fit(EXPERIMENT, 10, seed=5, num_seeds=3, run_dir=run_dir, **OPTIONS), run_dir


@pytest.mark.slow
def test_each_seed_is_the_single_run_of_that_seed_bit_by_bit(three_seeds):
    states, rows, _ = three_seeds
    for index, seed in ((0, 5), (2, 7)):
        alone, alone_rows = fit(EXPERIMENT, 10, seed=seed, progress=False)
        assert_same(one(states, index), alone)
        returns = [row["eval/return"] for row in rows if row["seed"] == seed]
        assert returns == [row["eval/return"] for row in alone_rows]


@pytest.mark.slow
def test_rows_keep_seeds_apart(three_seeds):
    _, rows, run_dir = three_seeds
    assert [(row["update"], row["seed"]) for row in rows] == [(u, s) for u in (0, 3, 6, 9, 10) for s in (5, 6, 7)]
    on_disk = files.read_rows(run_dir / "metrics.csv")
    np.testing.assert_array_equal(*[np.float32([row["eval/return"] for row in x]) for x in (on_disk, rows)])
    assert json.loads((run_dir / "manifest.json").read_text())["seeds"] == [5, 6, 7]


@pytest.mark.slow
def test_several_seeds_resume_to_the_same_end(three_seeds, tmp_path):
    states, _, run_dir = three_seeds
    fit(EXPERIMENT, 4, seed=5, num_seeds=3, run_dir=tmp_path / "run", **OPTIONS)
    resumed, _ = fit(EXPERIMENT, 10, seed=5, num_seeds=3, run_dir=tmp_path / "run", resume=True, **OPTIONS)
    assert_same(resumed, states)
    lines = [(path / "metrics.csv").read_text().splitlines() for path in (run_dir, tmp_path / "run")]
    time = lines[0][0].split(",").index("wall_seconds")
    without_time = [[[x for i, x in enumerate(line.split(",")) if i != time] for line in of_run] for of_run in lines]
    assert without_time[0] == without_time[1]


@pytest.mark.slow
def test_side_by_side_by_vmap_is_the_same_to_rounding(three_seeds, monkeypatch):
    monkeypatch.setattr(ensemble, "CPU_WIDTH", 3)
    states, _ = fit(EXPERIMENT, 10, seed=5, num_seeds=3, progress=False)
    assert_same(states.learner.params, three_seeds[0].learner.params, atol=1e-5)


@pytest.mark.slow
def test_a_program_that_would_not_fit_takes_fewer_runs_at_a_time_and_says_if_one_is_too_many(monkeypatch):
    monkeypatch.setattr(ensemble, "CPU_WIDTH", 4)
    monkeypatch.setattr(ensemble, "free_memory", lambda: 1e3)
    batch, said = ensemble.make_batch([EXPERIMENT], 4), []
    states = ensemble.init_batch(batch, range(4))
    ensemble.compile_batch(batch, states, 3, said.append)
    assert [text[:24] for text in said] == ["4 vectorized runs need 0", "training needs 0.0 GiB o"]
    assert said[0].endswith("1 at a time")
    assert said[1].endswith(ensemble.LESS_MEMORY)


def test_what_a_container_may_take_is_its_limit_less_what_it_cannot_drop(tmp_path):
    assert ensemble._allotted(tmp_path) == math.inf
    for folder, limit, used, cached in (
        (tmp_path / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        (tmp_path, "memory.max", "memory.current", "inactive_file"),
    ):
        folder.mkdir(exist_ok=True)
        (folder / "memory.stat").write_text(f"anon 5\n{cached} 100\n")
        (folder / limit).write_text("1000\n")
        (folder / used).write_text("700\n")
        assert ensemble._allotted(tmp_path) == 400
    (tmp_path / "memory" / "memory.limit_in_bytes").unlink()
    (tmp_path / "memory.max").write_text("max\n")
    assert ensemble._allotted(tmp_path) == math.inf


@pytest.fixture(scope="module")
def with_a_diverging_run(tmp_path_factory):
    """Train two runs of two seeds in one program; one of the runs diverges."""
    runs_dir = tmp_path_factory.mktemp("runs")
    runs = [Run(x, settings(10), runs_dir / name) for x, name in ((EXPERIMENT, "good"), (DIVERGING, "bad"))]
    return *fit_runs(runs, progress=False), runs


def settings(num_updates):
    return config.RunSettings(seed=5, num_seeds=2, num_updates=num_updates, checkpoint_seconds=0.0)


@pytest.mark.slow
def test_a_diverging_run_is_frozen_and_the_others_go_on(with_a_diverging_run, three_seeds):
    states, (good, bad), runs = with_a_diverging_run
    for index in (0, 1):
        assert_same(one(states, index), one(three_seeds[0], index))
    assert [row["update"] for row in good if row["seed"] == 5] == [0, 3, 6, 9, 10]
    assert {row["update"] for row in bad} == {0}
    assert np.asarray(states.is_finite).tolist() == [True, True, False, False]
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(states.learner.params))
    restored = checkpoint.restore(runs[1].run_dir / "checkpoints", abstract_state(EXPERIMENT, 2))
    assert restored.record["diverged"].keys() == {"5", "6"}


@pytest.mark.slow
def test_runs_of_several_experiments_resume_together(with_a_diverging_run, tmp_path):
    states, _, runs = with_a_diverging_run

    def train(runs, num_updates, resume):
        runs = [Run(run.experiment, settings(num_updates), tmp_path / run.run_dir.name) for run in runs]
        return fit_runs(runs, resume=resume, progress=False)

    train(runs, 4, resume=False)
    train(runs[:1], 7, resume=True)  # one run is now ahead of the other
    resumed, (good, _) = train(runs, 10, resume=True)
    assert_same(resumed, states)
    assert [row["update"] for row in good if row["seed"] == 6] == [0, 3, 6, 9, 10]


@pytest.mark.slow
def test_when_all_seeds_diverge_training_stops():
    with pytest.raises(DivergedError, match="training stopped"):
        fit(DIVERGING, 10, num_seeds=2, progress=False)


def test_experiments_of_other_shapes_cannot_be_side_by_side():
    with pytest.raises(ValueError, match="differ in numeric"):
        ensemble.make_batch([EXPERIMENT, EXPERIMENT.replace(num_steps=6)], 1)


SPREAD = """
import sys, jax, numpy as np
from tests_config import EXPERIMENT, train
num_runs = int(sys.argv[1])
states, mesh = train(num_runs)
assert dict(mesh.shape) == {"runs": int(sys.argv[2]), "envs": int(sys.argv[3])}, mesh
np.savez(sys.argv[4], *map(np.asarray, jax.tree.leaves(states.learner.params)))
"""
CONFIG = f"""
import jax, numpy as np
from jaxswarm import config
from jaxswarm.host import ensemble
EXPERIMENT = config.build(config.compose({OVERRIDES.split()!r}))
def train(num_runs):
    batch = ensemble.make_batch([EXPERIMENT], num_runs)
    states = ensemble.init_batch(batch, range(5, 5 + num_runs))
    program = ensemble.compile_batch(batch, states, 3, print)
    for _ in range(4):
        states, metrics = program(batch.experiments, states, np.int32(3))
    assert all(len(x.sharding.device_set) == batch.mesh.size for x in jax.tree.leaves(states.envs))
    return states, batch.mesh
"""


@pytest.mark.parametrize(
    ("num_runs", "num_envs", "num_devices", "shape"),
    [
        (4, 32, 2, (2, 1)),
        (1, 32, 8, (1, 8)),
        (3, 32, 2, (1, 2)),
        (8, 32, 12, (8, 1)),
        (10, 32, 12, (10, 1)),
        (1, 7, 2, (1, 1)),
    ],
)
def test_as_many_devices_as_possible_are_used(num_runs, num_envs, num_devices, shape):
    assert ensemble.mesh_shape(num_runs, num_envs, num_devices) == shape


def test_numbers_of_a_batch_may_be_arrays():
    rates = [np.array([1e-3, 2e-3]), np.array([3e-3, 4e-3])]
    experiments = [EXPERIMENT.replace(learner=EXPERIMENT.learner.replace(learning_rate=x)) for x in rates]
    found = ensemble.make_batch(experiments, 2).experiments.learner.learning_rate
    np.testing.assert_array_equal(found, np.float32([rates[0], rates[0], rates[1], rates[1]]))


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
@pytest.mark.parametrize(("num_runs", "mesh"), [(8, (8, 1)), (2, (2, 4)), (1, (1, 4))])
def test_on_eight_devices_results_are_those_of_one(num_runs, mesh, tmp_path):
    (tmp_path / "tests_config.py").write_text(CONFIG)
    flags = "--xla_force_host_platform_device_count=8"
    found = tmp_path / "found.npz"
    command = [sys.executable, "-c", SPREAD, str(num_runs), *map(str, mesh), str(found)]
    subprocess.run(command, env=os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": str(tmp_path)}, check=True, timeout=300)
    for index in range(num_runs):
        state = jaxswarm.init(EXPERIMENT, jax.random.key(5 + index))
        expected = jax.tree.leaves(jaxswarm.train(EXPERIMENT, state, 12)[0].learner.params)
        for a, b in zip(np.load(found).values(), expected, strict=True):
            np.testing.assert_allclose(a[index], b, atol=1e-5)


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
@pytest.mark.parametrize("num_seeds", [2, 1])
def test_two_processes_train_together_and_the_first_one_writes(num_seeds, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    overrides = [*OVERRIDES.split(), f"num_seeds={num_seeds}", "seed=5", "num_updates=10", "checkpoint_seconds=0"]
    run = "import sys; from jaxswarm.cli import train; sys.exit(train.main(sys.argv[1:]))"

    def start(index, *overrides):
        env = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": str(index)}
        command = [sys.executable, "-c", run, *overrides]
        return subprocess.Popen(command, cwd=tmp_path, env=os.environ | env, stdout=subprocess.PIPE, text=True)

    for attempt in ([*overrides, "run_dir=run"], ["resume=run", "num_updates=12"]):
        processes = [start(index, *attempt) for index in (0, 1)]
        outputs = [process.communicate(timeout=200)[0] for process in processes]
        assert [process.returncode for process in processes] == [0, 0]
        assert "done: " in outputs[0]
        assert [line for line in outputs[1].splitlines() if "Gloo" not in line] == []  # Gloo prints a line of its own
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    rows = files.read_rows(tmp_path / "run" / "metrics.csv")
    _, expected = fit(EXPERIMENT, 12, seed=5, num_seeds=num_seeds, progress=False)
    kept = [row for row in rows if row["update"] != 10]  # the first session ended there
    assert [(row["update"], row["seed"]) for row in kept] == [(row["update"], row["seed"]) for row in expected]
    np.testing.assert_allclose(
        [row["eval/return"] for row in kept], [row["eval/return"] for row in expected], rtol=1e-5
    )
