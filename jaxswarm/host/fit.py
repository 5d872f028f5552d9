"""Training in chunks of updates; between chunks the host reports progress, writes files and saves checkpoints.

While the host works on the results of one chunk, the device computes the next one, so that writing files costs no
training time. The arithmetic does not depend on where chunks end: states and metrics equal those of `train`, compiled
with the same options, bit for bit, however often a run was stopped and resumed. Several seeds, and several runs, are
trained in one program; see `ensemble`, which compiles it.
"""

import contextlib
import dataclasses
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxswarm import config as configs
from jaxswarm import files, render
from jaxswarm.config import RunSettings
from jaxswarm.files import Row
from jaxswarm.host import ensemble, estimate, loggers, trained
from jaxswarm.host.batch_recorder import BatchRecorder, Chunk, DivergedError
from jaxswarm.host.checkpoint import Restored
from jaxswarm.host.ensemble import RunBatch
from jaxswarm.host.metrics_log import MetricsLog
from jaxswarm.host.progress import Progress
from jaxswarm.host.recorder import Recorder, plot_curve
from jaxswarm.host.resume import ResumePoint, final_lines, resume_points
from jaxswarm.host.run import Run, check_folder, locked, split_started
from jaxswarm.host.signals import stop_requests
from jaxswarm.training import Experiment, TrainState, init

__all__ = ["DivergedError", "fit", "fit_runs"]

MAX_CHUNK = 64  # updates


def fit(
    experiment: Experiment,
    num_updates: int,
    *,
    seed: int = 0,
    num_seeds: int | None = None,
    run_dir: str | Path | None = None,
    resume: bool = False,
    force: bool = False,
    progress: bool = True,
    checkpoint_seconds: float = 30.0,
    keep_checkpoints: int = 3,
    log_to: tuple[str, ...] = (),
    on_evaluation: Callable[[int, Any], None] | None = None,
    init_params: Any = None,
) -> tuple[TrainState, list[Row]]:
    """Train until `num_updates` updates are done, or until Ctrl-C or SIGTERM, after the current chunk.

    Returns the state and a row per evaluation and seed: `update` is the number of updates done before the evaluated
    policy, and training metrics are means over the updates since the previous row. With `num_seeds` the seeds `seed`,
    `seed + 1`, ... are trained in one program and the leaves of the state are [seeds, ...]. `on_evaluation` is called
    with the update and the parameters [seeds, ...] of each evaluated policy but the last. With `init_params` all seeds
    start from these parameters, as `jaxswarm.load` returns them, of a network with the same parameter shapes.

    With `run_dir` the folder gets `config.yaml` (if `config.describe` finds a config for the experiment),
    `manifest.json`, `metrics.csv`, `checkpoints/` (the latest `keep_checkpoints` and the best, saved at most every
    `checkpoint_seconds`) and `curve.png`. With `resume` the run continues from its last checkpoint. If the settings
    or the rows of `metrics.csv` have changed since, `force` continues with the new ones.

    Raises:
        DivergedError: All seeds have diverged.
        CheckpointError: There are checkpoints, but none can be restored.
        FileExistsError: The folder holds another run, or evaluations without checkpoints.
        ConfigError: A setting is impossible, or the folder has changed since the checkpoint.
        OSError: A file cannot be written; the last checkpoint is intact.
    """
    for name in log_to:
        loggers.import_package(name)
    given: dict[str, Any] = {
        "seed": seed,
        "num_seeds": 1 if num_seeds is None else num_seeds,
        "num_updates": num_updates,
        "checkpoint_seconds": checkpoint_seconds,
        "keep_checkpoints": keep_checkpoints,
        "loggers": log_to,
    }
    settings = RunSettings(**given)
    folder = None if run_dir is None else Path(run_dir)
    config = None if folder is None else _described(experiment, given, folder)
    run = Run(experiment, settings, folder, config, on_evaluation, init_params)
    states, (rows,) = fit_runs([run], resume=resume, force=force, progress=progress)
    return (jax.tree.map(lambda x: x[0], states) if num_seeds is None else states), rows


def _described(experiment: Experiment, given: Mapping[str, Any], run_dir: Path) -> Mapping[str, Any] | None:
    """Return the config of the experiment, `None` after a warning if no config describes it."""
    config = configs.describe(experiment, **given)
    if config is None:
        warnings.warn(f"{run_dir} gets no config, so only `fit` can read it; see `config.describe`", stacklevel=3)
    return config


def fit_runs(
    runs: Sequence[Run], *, resume: bool = False, progress: bool = True, force: bool = False
) -> tuple[TrainState, list[list[Row]]]:
    """Train several runs in one program, as `fit` does; they differ in numbers, seeds and folders only.

    Returns states with a leading axis, the seeds of the first run first, and the rows of each run. With `resume`, all
    runs resume from the last update of which each has a checkpoint; new runs and runs to resume are not mixed.
    """
    for run in runs:
        check_folder(run, resume, force)
        for name in run.settings.loggers:
            loggers.import_package(name)
    estimate.check_training(runs[0].experiment, sum(len(run.seeds) for run in runs))
    runs = [_prepared(run) for run in runs]
    started, new = split_started([run.run_dir for run in runs if run.run_dir])
    if started and new:
        raise FileExistsError(
            f"{started[0]} holds a run and {new[0]} does not; runs of one program are all new or all resumed"
        )
    with contextlib.ExitStack() as locks:
        for run in runs:
            if run.run_dir and jax.process_index() == 0:
                locks.enter_context(locked(run.run_dir))
                check_folder(run, resume, force)  # another process may have trained into it since the first check
        return _fit(runs, resume_points(runs, force) if resume else None, progress)


def _prepared(run: Run) -> Run:
    """Return the run with the parameters of its warm start and with its replay pages; raises a `ConfigError`."""
    params, on_evaluation = run.init_params, run.on_evaluation
    if params is None and run.run_dir:
        params = trained.warm_start(run.settings, run.run_dir)
    if params is not None:
        needed = jax.eval_shape(init, run.experiment, jax.random.key(0)).learner.params
        trained.check_params(params, needed, run.settings.init_from)
    if on_evaluation is None and run.run_dir and run.settings.render_every:
        on_evaluation = render.hook(run.run_dir, run.experiment, run.settings.render_every)
    return dataclasses.replace(run, init_params=params, on_evaluation=on_evaluation)


def _fit(runs: Sequence[Run], points: list[ResumePoint] | None, progress: bool) -> tuple[TrainState, list[list[Row]]]:
    """Train runs whose folders are locked."""
    is_first = jax.process_index() == 0  # of several processes, only the first one writes and prints
    num_updates = runs[0].num_updates
    restored = [point.restored for point in points] if points else []
    if restored and restored[0].update >= num_updates:
        if progress and is_first:
            print(f"{runs[0].run_dir} is finished: {restored[0].update} of {num_updates} updates are done")
        return _concatenate(restored), [_finished_rows(*pair) for pair in zip(runs, restored, strict=True)]
    batch = ensemble.make_batch([run.experiment for run in runs], len(runs[0].seeds))
    runs = runs if is_first else [dataclasses.replace(run, run_dir=None, on_evaluation=None) for run in runs]
    start = restored[0].update if restored else 0
    agent_steps = runs[0].experiment.agent_steps_per_update * batch.num_runs
    with Progress(start, num_updates, agent_steps, progress and is_first) as shown, stop_requests() as stop:
        recorders = [Recorder(run, points[i] if points else None) for i, run in enumerate(runs)]
        wall_seconds = restored[0].record["wall_seconds"] if restored else 0.0
        recorder = BatchRecorder(batch, recorders, shown, start, wall_seconds, ensemble.broadcast_from_first)
        with recorder:
            states = ensemble.place(batch, _concatenate(restored)) if restored else _initial(batch, runs)
            states = _train(states, num_updates, recorder, stop)
    return states, [one.rows for one in recorders]


def _initial(batch: RunBatch, runs: Sequence[Run]) -> TrainState:
    """Return the states before the first update."""
    states = ensemble.init_batch(batch, [seed for run in runs for seed in run.seeds])
    given = [run.init_params for run in runs for _ in run.seeds]
    if all(params is None for params in given):
        return states
    own = states.learner.params
    params = (jax.tree.map(lambda x, i=i: x[i], own) if x is None else x for i, x in enumerate(given))
    return ensemble.with_params(states, list(params))


def _train(states: TrainState, num_updates: int, recorder: BatchRecorder, stop: threading.Event) -> TrainState:
    """Update until the last update or a stop request; a chunk is dispatched before the previous one is recorded."""
    update, in_flight = recorder.start, None
    eval_every = recorder.recorders[0].run.experiment.eval_every
    size = min(eval_every, MAX_CHUNK)
    program = ensemble.compile_batch(recorder.batch, states, size, recorder.progress.warn)
    while update < num_updates:
        length = min(eval_every - update % eval_every, num_updates - update, size, recorder.chunk_length())
        decisions = (length, recorder.is_checkpoint_due(), stop.is_set())
        length, is_due, is_stopped = ensemble.broadcast_from_first(*decisions)
        if is_stopped:
            break
        is_wanted = recorder.needs_states and (update % eval_every == 0 or is_due)
        before = _copy(states) if is_wanted else None
        states, metrics = program(recorder.batch.experiments, states, np.int32(length))
        if in_flight:
            recorder.record(in_flight)
            recorder.report_diverged(states)
        else:
            recorder.progress.begin()
            recorder.open()
        in_flight = Chunk(update, length, metrics, before, bool(is_due))
        update += length
    if in_flight:
        recorder.record(in_flight)
        recorder.report_diverged(states)
    recorder.finish(update, states, is_complete=update == num_updates)
    return states


@jax.jit
def _copy(states: TrainState) -> TrainState:
    """Copy the states into new buffers, because the next chunk overwrites its input."""
    return jax.tree.map(jnp.copy, states)


def _concatenate(restored: Sequence[Restored]) -> TrainState:
    return jax.tree.map(lambda *x: jnp.concatenate(x), *[x.train_state for x in restored])


def _finished_rows(run: Run, restored: Restored) -> list[Row]:
    lines = final_lines(run, restored)
    if jax.process_index() == 0:
        MetricsLog(run.folder, lines)
    rows = files.parse_rows(lines)
    if rows and not (run.folder / "curve.png").exists():
        plot_curve(run, rows)
    return rows
