"""Every benchmark runs, at its smallest size, and prints figures that are possible; nothing is asked of their size."""

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
    "box_physics": ["worlds=1", "seconds=0.01"],
    "environment_throughput": ["worlds=1", "agents=3", "repeats=1"],
    "projections": ["rows=8", "repeats=1"],
    "seeds": ["seeds=1,2", "updates=1", *TINY],
    "training_throughput": ["repeats=1", "threshold=-9999", "seeds=2", "num_updates=2", *TINY],
}


def numbers(tree):
    """All of them, at any depth."""
    if isinstance(tree, dict | list):
        return [x for item in (tree.values() if isinstance(tree, dict) else tree) for x in numbers(item)]
    return [tree] if isinstance(tree, int | float) else []


def test_all_benchmarks_are_run_here():
    assert {path.stem for path in BENCHMARKS.glob("*.py")} == {*OVERRIDES, "timing"}


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
@pytest.mark.parametrize("name", sorted(OVERRIDES))
def test_benchmark_prints_possible_figures(name):
    if name == "box_physics" and not importlib.util.find_spec("Box2D"):
        pytest.skip("Box2D is not installed")
    run = subprocess.run(
        [sys.executable, BENCHMARKS / f"{name}.py", *OVERRIDES[name]], check=False, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    rows = [json.loads(line) for line in run.stdout.splitlines()]
    assert rows
    for row in rows:
        assert numbers(row)
        found = row.pop("to_return", None)
        assert all(math.isfinite(x) and x >= 0 for x in numbers(row)), row
        assert found is None or 0 <= found["seconds_to_threshold"] < found["seconds"]
