"""A run that is killed at any moment resumes to the same numbers, and readers beside it see complete states only."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from jaxswarm import files
from jaxswarm.files import is_vacant
from jaxswarm.host.run import has_checkpoint, load_config
from jaxswarm.host.trained import load_policies

PROGRAM = [sys.executable, "-c", "import sys; from jaxswarm.cli.train import main; sys.exit(main())"]
OVERRIDES = [
    *["task.num_agents=3", "task.episode_length=5", "num_envs=2", "num_steps=4", "learner.batch_size=12"],
    *["num_eval_envs=1", "eval_every=50", "network.encoder=[4]", "network.decoder=[4]", "num_updates=2000"],
    *["checkpoint_seconds=0", "keep_checkpoints=1"],
]


def start(run_dir):
    arguments = [*OVERRIDES, f"run_dir={run_dir}"] if is_vacant(run_dir) else [f"resume={run_dir}"]
    return subprocess.Popen([*PROGRAM, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def table(run_dir):
    rows = files.read_rows(run_dir / "metrics.csv")
    return [{name: x for name, x in row.items() if name != "wall_seconds"} for row in rows]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Return the folder of a run without kills, and the seconds that it took."""
    run_dir, began = tmp_path_factory.mktemp("kills") / "run", time.monotonic()
    _, error = (process := start(run_dir)).communicate(timeout=300)
    assert process.returncode == 0, error
    return run_dir, time.monotonic() - began


@pytest.mark.slow
def test_kills_at_random_moments(undisturbed, tmp_path, record_property, pytestconfig):
    expected, seconds = undisturbed
    num_kills = max(2, pytestconfig.getoption("tries") // 20)
    record_property("tries", num_kills)
    random, run_dir = np.random.default_rng(os.getpid()), tmp_path / "run"
    for _ in range(num_kills):
        process = start(run_dir)
        time.sleep(random.uniform(0.2, 1.0) * seconds)
        process.send_signal(signal.SIGKILL)
        process.communicate()
    _, error = (process := start(run_dir)).communicate(timeout=300)
    assert process.returncode == 0, error
    assert "warning" not in error
    np.testing.assert_equal(table(run_dir), table(expected))
    assert not [path for path in run_dir.rglob(".*") if path.name.endswith(".tmp")]


@pytest.mark.slow
def test_readers_beside_a_training_run(tmp_path):
    run_dir, warnings, num_loads = tmp_path / "run", [], 0
    process = start(run_dir)
    while process.poll() is None:
        if has_checkpoint(run_dir):
            for which in ("best", "last"):
                load_policies(run_dir, load_config(run_dir), which, [0], warnings.append)
                num_loads += 1
        time.sleep(0.01)
    _, error = process.communicate()
    assert process.returncode == 0, error
    assert num_loads > 5
    assert warnings == []
