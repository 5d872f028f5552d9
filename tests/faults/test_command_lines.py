"""Random command lines of every program: a clear answer within seconds, no traceback, and nothing left on disk.

Accepted lines end where the program would compile.
"""

import contextlib
import io
import shutil
import time

import jax
import jax.numpy as jnp
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxswarm import config as configs
from jaxswarm import export as export_module
from jaxswarm import render as render_module
from jaxswarm import rollout
from jaxswarm.cli import evaluate, export, figure, plot, render, sweep, train
from jaxswarm.config import renamed
from jaxswarm.host import ensemble, trained
from jaxswarm.host.checkpoint import Restored

SECONDS = 5.0  # of processor time for an answer
RANDOM = settings(deadline=None, database=None, suppress_health_check=list(HealthCheck), print_blob=False)

GROUPS = configs.choices()
CONFIGS = [configs.compose([f"{group}={name}"]) for group in configs.REGISTERED for name in GROUPS[group]]
KEYS = sorted({key for config in CONFIGS for key in configs.flat(config)} - {"imports"})
LEAVES = sorted({key.rpartition(".")[2] for key in KEYS})
NAMES = [name for names in GROUPS.values() for name in names]
ODD = [
    *("", "null", "true", "[]", "{}", "{a:1}", "[null]", "[[1]]", "[1,2]", "[a]", "1,2", "a,b", "[1],[2]", "1..3:2"),
    *("glob(*)", "[glob(*)]", "choice(1,2)", "range(1,3)", "interval(1,2)", "sort(2,1)", "shuffle(1,2)", "int(2)"),
    *(
        "${seed}",
        "${oc.env:HOME}",
        "???",
        "'a",
        '"1"',
        "\\",
        "a=b",
        "@",
        "~",
        "é",
        "1e3",
        "1e30",
        "-1e30",
        "1e400",
        "nan",
    ),
    *("inf", "-inf", "-1", "0", "0.5", "1", "2", "3", "2147483647", "2147483648", "4294967296", "100000", "1000000"),
    *("100000000", "9" * 30, "9" * 5000, "[1000000000]", "[65536,65536]", "[2147483648]", f"[{'1,' * 99}1]", "a" * 300),
    *("run", "nowhere", "/proc/x", "/dev/null", "/dev/null/x", "\0", "run/config.yaml", "x.png", "x.jax", "x.html"),
]

values = st.one_of(
    st.sampled_from([*ODD, *NAMES]),
    st.integers(-(2**70), 2**70).map(str),
    st.floats(width=32).map(repr),
    st.lists(st.integers(-2, 2**33), max_size=4).map(lambda x: str(x).replace(" ", "")),
    st.text("ab10.,:=[](){}'\"$*- \\é", max_size=8),
)
keys = st.one_of(
    st.sampled_from([*KEYS, *GROUPS, *LEAVES, *renamed.OF_OTHER_LIBRARIES, *renamed.KEYS]),
    st.text("abls._0", max_size=6),
)
overrides = st.lists(st.tuples(keys, values).map("=".join), max_size=3)


def options(module, names=None):
    """Return random options of a program."""
    return st.lists(st.tuples(st.sampled_from(names or module.OPTIONS), values).map("=".join), max_size=2)


PLOT_OPTIONS = list(plot.Options.__dataclass_fields__)
COMMANDS = {
    "train": (train.main, [], options(train, ["run_dir", "resume", "init_from"]), overrides),
    "sweep": (sweep.main, [], options(sweep), overrides),
    "eval": (evaluate.main, ["run"], options(evaluate), overrides),
    "render": (render.main, ["run"], options(render), overrides),
    "export": (export.main, ["run"], options(export), overrides),
    "plot": (plot.main, ["run"], options(plot, PLOT_OPTIONS), overrides),
    "figure": (figure.main, ["best_rendezvous", "seeds=1"], options(figure), overrides),
}


def accepted(*_, **__):
    """End a program as Ctrl-C does."""
    raise KeyboardInterrupt


@pytest.fixture
def here(run_dir, tmp_path, monkeypatch):
    """Work in a folder that holds a run, and replace everything that compiles or restores."""
    shutil.copytree(run_dir, tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    for module, name in (
        *((ensemble, "make_batch"), (rollout, "evaluate"), (render_module, "record"), (plot, "_write")),
        (export_module, "export_policy"),
    ):
        monkeypatch.setattr(module, name, accepted)

    def restore(path, template, *_, **__):
        return Restored(1, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), template), {}, 0.0)

    monkeypatch.setattr(trained, "restore", restore)
    return tmp_path


def answer(main, arguments):
    """Run a program; return its exit code, its output and errors, and the seconds of processor time."""
    out, err, start = io.StringIO(), io.StringIO(), time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(arguments)
    return code, out.getvalue(), err.getvalue(), time.process_time() - start


def check_answer(main, arguments, here, limit=SECONDS):
    """Check the answer to one command line, and remove what an accepted line has written."""
    before = {path: path.read_bytes() if path.is_file() else b"" for path in here.rglob("*")}
    code, _, err, seconds = answer(main, arguments)
    assert code in (0, 2, 130), err
    assert seconds < limit, arguments
    if code == 2 and arguments:  # without arguments, programs print their help
        assert err.splitlines()[-1].startswith("error: ")
        assert "Traceback" not in err
        assert len(err.splitlines()[-1]) < 2000
    left = {path: path.read_bytes() if path.is_file() else b"" for path in here.rglob("*")}
    if code == 2:
        assert left == before, arguments
    for path in sorted(left.keys() - before.keys(), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()


@pytest.mark.slow
@pytest.mark.parametrize("program", COMMANDS)
def test_random_command_lines_are_answered(program, here, tries):
    main, fixed, own, others = COMMANDS[program]
    check_answer(main, [*fixed, "task.num_agents=4"], here, limit=60)  # imports what the program needs

    @settings(RANDOM, max_examples=tries)
    @given(own, others)
    def check(own, others):
        check_answer(main, [*fixed, *own, *others], here)

    check()
