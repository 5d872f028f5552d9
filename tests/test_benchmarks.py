"""Every benchmark runs at its smallest size and prints valid numbers, and its `--help` prints its docstring.

No test depends on how large the measured numbers are.
"""

import ast
import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
TINY = ["num_envs=2", "num_steps=4", "learner.batch_size=20", "num_eval_envs=1"]
OVERRIDES = {
    "aggregation": ["aggregators=mean,max", "rows=8", "slots=3", "features=4", "repeats=1"],
    "box_physics": ["num_envs=1", "seconds=0.01"],
    "environment_throughput": ["num_envs=1", "num_agents=3", "repeats=1"],
    "memory_growth": ["evaluations=3", "measurements=2"],
    "projections": ["rows=8", "repeats=1"],
    "seeds": ["seeds=1,2", "updates=1", *TINY],
    "training_throughput": ["repeats=1", "threshold=-9999", "seeds=2", "num_updates=2", *TINY],
}


def numbers(tree):
    """Return all numbers of nested lists and dicts."""
    if isinstance(tree, dict | list):
        return [x for item in (tree.values() if isinstance(tree, dict) else tree) for x in numbers(item)]
    return [tree] if isinstance(tree, int | float) else []


def output(name, *overrides):
    """Return what the benchmark prints."""
    command = [sys.executable, BENCHMARKS / f"{name}.py", *overrides]
    run = subprocess.run(command, check=False, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_all_benchmarks_are_run_here():
    assert {path.stem for path in BENCHMARKS.glob("*.py")} == {*OVERRIDES, "timing"}


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
@pytest.mark.parametrize("name", sorted(OVERRIDES))
def test_benchmark_prints_possible_figures(name):
    if name == "box_physics" and not importlib.util.find_spec("Box2D"):
        pytest.skip("Box2D is not installed")
    rows = [json.loads(line) for line in output(name, *OVERRIDES[name]).splitlines()]
    assert rows
    for row in rows:
        assert numbers(row)
        found = row.pop("to_return", None)
        assert all(math.isfinite(x) and x >= 0 for x in numbers(row)), row
        assert found is None or 0 <= found["seconds_to_threshold"] < found["seconds"]


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(OVERRIDES))
def test_help_prints_the_docstring(name):
    docstring = ast.get_docstring(ast.parse((BENCHMARKS / f"{name}.py").read_text()), clean=False)
    assert f"python benchmarks/{name}.py [" in docstring
    assert output(name, "--help") == docstring + "\n"
