"""Make JAX strict in every test: shapes are checked at run time, and rank promotion raises an error."""

import os

import jax
import jaxtyping
import pytest

jaxtyping.install_import_hook("jaxswarm", "beartype.beartype")

jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config):
    """Cache compiled programs for other tests, for the programs that tests start, and for the next run of the tests.

    Fast tests spend most of their time compiling, so `-m "not slow"` compiles with few optimizations. Otherwise, tests
    compile with all optimizations, as users do.
    """
    home = config.cache.mkdir("xdg")
    os.environ["XDG_CACHE_HOME"] = str(home)
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    jax.config.update("jax_compilation_cache_dir", str(home / "jaxswarm" / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_disable_most_optimizations", config.option.markexpr == "not slow")


@pytest.fixture
def few_optimizations(monkeypatch):
    """Halve the compile time with few optimizations, for slow tests that only check whether programs run or agree."""
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="session")
def run_dir(tmp_path_factory):
    """Return the folder of a tiny run with one checkpoint."""
    from jaxswarm import config as configs  # noqa: PLC0415
    from jaxswarm.host.checkpoint import Checkpoints  # noqa: PLC0415
    from jaxswarm.training import init  # noqa: PLC0415

    overrides = (
        "task.num_agents=3 task.episode_length=5 num_envs=2 num_steps=4 learner.batch_size=12 num_eval_envs=1 "
        "eval_every=3 network.encoder=[4] network.decoder=[4] num_updates=1"
    )
    run_dir = tmp_path_factory.mktemp("runs") / "run"
    run_dir.mkdir()
    config = configs.compose(overrides.split())
    (run_dir / "config.yaml").write_text(configs.dump(config))
    checkpoints = Checkpoints(run_dir / "checkpoints")
    state = init(configs.build(config), jax.random.key(0))
    checkpoints.save(1, jax.tree.map(lambda x: x[None], state), {}, -3.0)  # one seed
    checkpoints.close()
    return run_dir
