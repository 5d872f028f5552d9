"""An exported policy agrees with the policy for any number of agents, and runs without this package."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export as jax_export

import jaxswarm
from jaxswarm import export
from jaxswarm.cli import export as program

KEY = jax.random.key(0)
LOAD = """if True:
    import sys
    import jax, numpy as np
    arrays = np.load(sys.argv[2])
    program = jax.export.deserialize(open(sys.argv[1], "rb").read())
    mean, std = program.call(arrays["own"], {"neighbors": (arrays["features"], arrays["mask"])})
    np.savez(sys.argv[3], mean=mean, std=std)
    assert not [name for name in sys.modules if name.startswith(("jaxswarm", "flax", "distrax"))]
"""


def inputs(obs):
    return obs.own, {name: (group.features, group.mask) for name, group in obs.groups.items()}


def check(task, network):
    """Check that the exported program agrees with the policy, for the whole swarm and for one of its agents."""
    obs = jax.jit(lambda: task.observe(task.reset(KEY)))()
    params = jax.jit(network.init)(KEY, obs)
    params = jax.tree.map(lambda x: x + 0.1, params)  # otherwise the means are almost 0
    exported = jax_export.deserialize(export.export_policy(task, network, params).serialize())
    expected = jax.jit(lambda: network.apply(params, obs, method="policy"))()
    own, groups = inputs(obs)
    for part in (slice(None), slice(1, 2)):
        mean, std = exported.call(*jax.tree.map(lambda x, part=part: x[part], (own, groups)))
        np.testing.assert_allclose(mean, expected.mean()[part], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(std, jnp.broadcast_to(expected.stddev(), expected.mean().shape)[part], rtol=1e-5)
    assert exported.platforms == export.PLATFORMS
    return exported, expected.mean(), own, groups


@pytest.mark.parametrize("name", jaxswarm.AGGREGATORS)
def test_every_aggregator_is_exported(name):
    task = jaxswarm.make("pursuit", num_agents=4, num_evaders=2)
    network = jaxswarm.ActorCritic(encoder=(4,), decoder=(4,), aggregator=jaxswarm.AGGREGATORS[name](), std="state")
    check(task, network)


@pytest.mark.parametrize("name", jaxswarm.TASKS)
def test_every_task_is_exported(name):
    check(jaxswarm.make(name, num_agents=3), jaxswarm.ActorCritic(encoder=(4,), decoder=(4,)))


def test_slots_that_are_not_needed_are_masked():
    task = jaxswarm.make("rendezvous", num_agents=6)
    exported, expected, own, groups = check(task, jaxswarm.ActorCritic(encoder=(4,), decoder=(4,)))
    features, mask = groups["neighbors"]
    few = mask & (jnp.arange(5)[None] < 2)
    some = exported.call(own, {"neighbors": (features, few)})[0]
    same = exported.call(own, {"neighbors": (jnp.where(few[..., None], features, 9.0), few)})[0]
    np.testing.assert_array_equal(some, same)
    assert np.abs(some - expected).max() > 1e-4


def test_the_file_needs_jax_only(run_dir, tmp_path, capsys):
    assert program.main([str(run_dir)]) == 0
    out = capsys.readouterr().out
    assert f"wrote {run_dir / 'policy.jax'}" in out
    assert "own is float32[agents,3], groups is {neighbors: (float32[agents,2,8], bool[agents,2])}" in out
    experiment, params = jaxswarm.load(run_dir)
    obs = jax.jit(lambda: experiment.task.observe(experiment.task.reset(KEY)))()
    group = obs.groups["neighbors"]
    np.savez(tmp_path / "obs.npz", own=obs.own, features=group.features, mask=group.mask)
    files = (run_dir / "policy.jax", tmp_path / "obs.npz", tmp_path / "actions.npz")
    subprocess.run([sys.executable, "-c", LOAD, *map(str, files)], check=True)
    expected = experiment.network.apply(params, obs, method="policy")
    with np.load(tmp_path / "actions.npz") as found:
        np.testing.assert_allclose(found["mean"], expected.mean(), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(found["std"], jnp.broadcast_to(expected.stddev(), (3, 2)), rtol=1e-5)


def test_a_policy_is_exported_for_more_agents(run_dir, tmp_path, capsys):
    assert program.main([str(run_dir), "checkpoint=last", "task.num_agents=50", f"out={tmp_path / 'new' / 'p'}"]) == 0
    assert "bool[agents,49]" in capsys.readouterr().out
    assert (tmp_path / "new" / "p").exists()


@pytest.mark.parametrize(
    ("overrides", "part"),
    [
        (["checkpoint=first"], "must be one of best, last"),
        (["train_seed=3"], "train_seed: must be one of the trained seeds"),
        (["num_envs=3"], "num_envs cannot be changed here"),
        (["task.dynamics=velocity"], "observations of other sizes"),
        (["nowhere"], "give one run folder, got 2"),
        (["task=pursuit"], "task: must be 'rendezvous', which the policy was trained with, got 'pursuit'"),
        (["out=policy.onnx"], "out: must end in .jax, got 'policy.onnx'"),
        (["out=/proc/x.jax"], "out: cannot write to /proc/x.jax"),
        (["task.num_agents=1000000"], "task.num_agents: must be small enough for the memory, got 1000000"),
    ],
)
def test_a_wrong_export_is_one_line(run_dir, tmp_path, capsys, overrides, part):
    assert program.main([str(run_dir), f"out={tmp_path / 'p'}", *overrides]) == 2
    err = capsys.readouterr().err
    assert part in err
    assert err.count("\n") == 1
    assert not (tmp_path / "p").exists()
