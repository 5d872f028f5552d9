"""Runs survive a machine that does not give them a core for a while, and a paused process."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from jaxswarm import files

SECONDS = 70  # XLA's own limit is 60 s
ONE_DEVICE_IS_LATE = f"""
import time
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, PartitionSpec as P
from jaxswarm.host import ensemble

ensemble.use_cores(2)
jax.config.update("jax_num_cpu_devices", 2)
mesh = jax.make_mesh((2,), ("runs",), (AxisType.Auto,))

def late(index, x):
    if int(np.asarray(index)) == 1:
        time.sleep({SECONDS})
    return np.asarray(x)

def local(x):
    shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
    return jax.lax.psum(jax.pure_callback(late, shape, jax.lax.axis_index("runs"), x), "runs")

x = jnp.arange(4.0)
print(jax.jit(jax.shard_map(local, mesh=mesh, in_specs=P("runs"), out_specs=P("runs"), check_vma=False))(x).tolist())
"""
TRAIN = [
    *["task.num_agents=3", "task.episode_length=5", "num_envs=2", "num_steps=4", "learner.batch_size=12"],
    *[
        "num_eval_envs=1",
        "eval_every=100",
        "network.encoder=[4]",
        "network.decoder=[4]",
        "num_updates=3000",
        "num_seeds=2",
    ],
]


def start(*arguments):
    return subprocess.Popen(
        [sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )


@pytest.mark.slow
def test_a_core_that_is_late_ends_no_program():
    out, error = start("-c", ONE_DEVICE_IS_LATE).communicate(timeout=300)
    assert json.loads(out) == [2.0, 4.0, 2.0, 4.0], error


@pytest.mark.slow
def test_a_paused_process_continues_with_the_same_bits(tmp_path):
    program = "import sys; from jaxswarm.cli.train import main; sys.exit(main())"
    tables = []
    for name, seconds in (("paused", SECONDS), ("undisturbed", 0)):
        process = start("-c", program, *TRAIN, f"run_dir={tmp_path / name}")
        while process.poll() is None and len(files.read_rows(tmp_path / name / "metrics.csv")) < 4:
            time.sleep(0.05)
        if seconds:
            process.send_signal(signal.SIGSTOP)
            time.sleep(seconds)
            process.send_signal(signal.SIGCONT)
        _, error = process.communicate(timeout=300)
        assert process.returncode == 0, error
        rows = files.read_rows(tmp_path / name / "metrics.csv")
        tables.append([{key: x for key, x in row.items() if key != "wall_seconds"} for row in rows])
    np.testing.assert_equal(*tables)
