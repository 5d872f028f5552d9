"""Make JAX strict in every test: shapes are checked at run time, and rank promotion raises an error.

Tests in `tests/faults/` damage run folders, disks and command lines. Each of their files is a kind of fault;
`python -m pytest tests/faults --tries=1000` runs all of them and ends with `kind: passed of tried`.
"""

import collections
import os
from pathlib import Path

import jax
import jaxtyping
import psutil
import pytest

jaxtyping.install_import_hook("jaxswarm", "beartype.beartype")

jax.config.update("jax_numpy_rank_promotion", "raise")

MAX_MEMORY = 2 * 2**30  # bytes


def pytest_addoption(parser):
    parser.addoption("--tries", type=int, default=20, help="number of random cases of each test in tests/faults")


@pytest.fixture
def tries(request, record_property):
    """Return the number of random cases of a test in `tests/faults`, which counts them in the summary."""
    number = request.config.getoption("tries")
    record_property("tries", number)
    return number


def pytest_terminal_summary(terminalreporter):
    """Print how many cases of each kind of fault passed; a random test counts as its number of tries."""
    counts = collections.defaultdict(collections.Counter)
    for outcome in ("passed", "failed", "error"):
        for report in terminalreporter.stats.get(outcome, []):
            path = Path(report.nodeid.split("::")[0])
            if path.parent.name == "faults":
                kind = path.stem.removeprefix("test_").replace("_", " ")
                counts[kind][outcome] += dict(report.user_properties).get("tries", 1)
    for kind, count in sorted(counts.items()):
        terminalreporter.write_line(f"{kind}: {count['passed']} passed of {count.total()} tried")


def pytest_configure(config):
    """Cache compiled programs for other tests, for the programs that tests start, and for the next run of the tests.

    Fast tests spend most of their time compiling, so `-m "not slow"` compiles with few optimizations. Otherwise, tests
    compile with all optimizations, as users do.
    """
    home = config.cache.mkdir("xdg")
    os.environ["XDG_CACHE_HOME"] = str(home)
    os.environ["XDG_STATE_HOME"] = str(config.cache.mkdir("state"))
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    jax.config.update("jax_compilation_cache_dir", str(home / "jaxswarm" / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_disable_most_optimizations", config.option.markexpr == "not slow")


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Drop the compiled programs of a file that has compiled many, because XLA crashes when it maps too much memory."""
    yield
    if psutil.Process().memory_info().rss > MAX_MEMORY:
        jax.clear_caches()


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
