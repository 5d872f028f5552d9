"""Strict JAX for every test: shapes checked at run time, rank promotion an error."""

import os

import jax
import jaxtyping
import pytest

jaxtyping.install_import_hook("jaxswarm", "beartype.beartype")

jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config):
    """Keeps what is compiled for other tests, for programs that they start, and for the next time tests are run.

    Compiling is most of what fast tests take, so that they compile with few optimisations. The slow ones, and all
    without `-m "not slow"`, compile as users do.
    """
    home = config.cache.mkdir("xdg")
    os.environ["XDG_CACHE_HOME"] = str(home)
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    jax.config.update("jax_compilation_cache_dir", str(home / "jaxswarm" / "xla"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_disable_most_optimizations", config.option.markexpr == "not slow")


@pytest.fixture
def few_optimisations(monkeypatch):
    """For slow tests that ask whether programs run, or run alike; compiling takes half the time."""
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
