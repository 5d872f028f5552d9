"""Memory and open files of a long run; prints one JSON line per measurement.

    python benchmarks/memory_growth.py [evaluations=10000] [measurements=10] [checkpoint_seconds=0.05] [out=FILE]

A tiny run evaluates its policy after every update and writes a run folder with rows, checkpoints and curves. At equal
distances, the resident memory (MB) and the number of open files of the process are measured. After the first tenth,
which includes compilation, both should stay the same.
"""

import sys
import tempfile
from pathlib import Path

import psutil
from timing import report, settings

import jaxswarm

TINY = (
    "task.num_agents=3 task.episode_length=5 num_envs=2 num_steps=4 learner.batch_size=12 num_eval_envs=1 eval_every=1 "
    "network.encoder=[4] network.decoder=[4]"
)


def main():
    options = settings(sys.argv[1:], evaluations="10000", measurements="10", checkpoint_seconds="0.05")
    experiment, num_updates = jaxswarm.experiment(*TINY.split()), int(options["evaluations"]) - 1
    distance = max(1, num_updates // int(options["measurements"]))
    process = psutil.Process()

    def measure(update, _):
        if update % distance == 0:
            row = {"update": update, "megabytes": process.memory_info().rss / 1e6, "files": process.num_fds()}
            report(row, options["out"])

    with tempfile.TemporaryDirectory() as folder:
        run_options = {"checkpoint_seconds": float(options["checkpoint_seconds"]), "on_evaluation": measure}
        jaxswarm.fit(experiment, num_updates, run_dir=Path(folder) / "run", progress=False, **run_options)


if __name__ == "__main__":
    main()
