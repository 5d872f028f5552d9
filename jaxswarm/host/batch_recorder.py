"""The results of all runs of one program: split among their recorders, timed, and reported."""

import errno
import time
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxswarm.files import Row
from jaxswarm.host import divergence, ensemble
from jaxswarm.host.ensemble import RunBatch
from jaxswarm.host.progress import Progress
from jaxswarm.host.recorder import Recorder
from jaxswarm.host.resume import resume_command
from jaxswarm.training import TrainState
from jaxswarm.types import Metrics

SECONDS_PER_CHUNK = 1.0  # target duration of a chunk, where single updates are faster


class DivergedError(RuntimeError):
    """All seeds of all runs have diverged (NaN or infinity); `rows` holds the evaluations of each run."""

    def __init__(self, message: str, rows: Sequence[list[Row]]):
        super().__init__(message)
        self.rows = list(rows)


class Chunk(NamedTuple):
    """Updates that have been dispatched to the device."""

    start: int  # updates done before
    length: int
    metrics: Metrics  # [runs, updates], on the device
    states_before: TrainState | None  # if they may have to be saved
    is_saved: bool


_REMEDIES = {errno.ENOSPC: "Free some space", errno.EDQUOT: "Free some space", errno.EROFS: "Make it writable"}


class BatchRecorder:
    """Pass the results of a batch to the recorder of each run, and measure time.

    The end of its context closes the recorders. An `OSError` then becomes one that says what was not saved.
    """

    def __init__(
        self,
        batch: RunBatch,
        recorders: Sequence[Recorder],
        progress: Progress,
        start: int,
        wall_seconds: float,
        agree: Callable[..., list[int]],
    ):
        self.batch = batch
        self.recorders = recorders
        self.progress = progress
        self.start = start
        runs = [recorder.run for recorder in recorders]
        self.needs_states = any(agree(*[bool(run.run_dir or run.on_evaluation) for run in runs]))
        self._checkpoint_seconds = runs[0].settings.checkpoint_seconds
        self._started = time.monotonic() - wall_seconds
        self._wall_seconds = wall_seconds  # when the last recorded chunk was done
        self._seconds_per_update: float | None = None
        self._num_done = start  # updates that have been computed
        self._last_save = time.monotonic()
        self._num_reported = 0

    def __enter__(self) -> "BatchRecorder":
        return self

    def __exit__(self, _: type | None, error: BaseException | None, __: TracebackType | None) -> None:
        failure = error if isinstance(error, OSError) else None
        for recorder in self.recorders:
            try:
                recorder.close()
            except OSError as of_close:
                failure = failure or of_close
        if failure and (error is None or failure is error):
            raise self._disk_error(failure) from failure

    def _disk_error(self, error: OSError) -> OSError:
        """Return the error with the number of updates that were not saved, and the command that resumes."""
        folder, num_saved = self.recorders[0].run.run_dir, min(recorder.last_saved for recorder in self.recorders)
        if folder is None:
            return error
        is_described = (folder / "config.yaml").exists()
        if self.recorders[0].was_described and not is_described:
            return OSError(f"{folder} was deleted or moved during training, so training stopped")
        text = f"{folder}: {(error.strerror or str(error)).lower()}; "
        text += f"the last {self._num_done - num_saved} updates were not saved. "
        if not is_described:
            return OSError(text + "Nothing was written")
        remedy = _REMEDIES.get(error.errno or 0, "Mend this")
        return OSError(f"{text}{remedy}, then run: {resume_command(folder)}")

    def open(self) -> None:
        """Prepare all run folders."""
        for recorder in self.recorders:
            recorder.open()

    def chunk_length(self) -> int:
        """Return the number of updates that take about `SECONDS_PER_CHUNK`; 1 until their speed is known."""
        if not self._seconds_per_update:
            return 1
        return max(1, int(SECONDS_PER_CHUNK / self._seconds_per_update))

    def is_checkpoint_due(self) -> bool:
        """Return whether the last checkpoint is at least `checkpoint_seconds` old."""
        return time.monotonic() - self._last_save >= self._checkpoint_seconds

    def record(self, chunk: Chunk) -> None:
        """Wait for a chunk and record its results."""
        metrics = jax.device_get(ensemble.fetch(self.batch, chunk.metrics))
        metrics = {name: x[:, : chunk.length] for name, x in metrics.items()}
        self._num_done = chunk.start + chunk.length
        states = ensemble.fetch(self.batch, chunk.states_before)
        for recorder, part in self._parts():
            own = {name: x[part] for name, x in metrics.items()}
            recorder.record(chunk.start, self._wall_seconds, own, _slice(states, part))
            if chunk.is_saved:
                recorder.save()
        if chunk.is_saved:
            self._last_save = time.monotonic()
        self._measure(chunk)
        returns = [x for recorder in self.recorders if (x := recorder.latest_return()) is not None]
        evaluation = (returns[0][0], float(np.median([x for _, x in returns]))) if returns else None
        self.progress.advance(chunk.start + chunk.length, evaluation)

    def finish(self, update: int, states: TrainState, is_complete: bool) -> None:
        """Save the final states, and evaluate them if training reached its end."""
        evaluation = None
        if is_complete:
            self.progress.announce("evaluating the final policy")
            evaluation = ensemble.fetch(self.batch, ensemble.evaluate_batch(self.batch, states))
            evaluation = jax.device_get(evaluation)
        states = ensemble.fetch(self.batch, states)
        for recorder, part in self._parts():
            own = None if evaluation is None else {name: x[part] for name, x in evaluation.items()}
            recorder.finish(update, self._wall_seconds, _slice(states, part), own)
        self.report_diverged(states)

    def _measure(self, chunk: Chunk) -> None:
        """Update the clock, and the speed from all chunks but the first, which includes compilation."""
        now = time.monotonic() - self._started
        if chunk.start > self.start:
            self._seconds_per_update = (now - self._wall_seconds) / chunk.length
        self._wall_seconds = now

    def _parts(self) -> Iterator[tuple[Recorder, slice]]:
        """Yield each recorder with its part of the runs axis."""
        size = self.batch.num_runs // len(self.recorders)
        for index, recorder in enumerate(self.recorders):
            yield recorder, slice(index * size, (index + 1) * size)

    def report_diverged(self, states: TrainState) -> None:
        """Save the frozen states of seeds that have diverged since the last call, and warn about them.

        `states` are those after the recorded chunk, or after a later one. Raises a `DivergedError` if no seed is left;
        with JAX_DEBUG_NANS, for the first seed.
        """
        diverged = [(recorder, seed) for recorder in self.recorders for seed in recorder.diverged]
        new, self._num_reported = diverged[self._num_reported :], len(diverged)
        if not new:
            return
        states = ensemble.fetch(self.batch, states)
        for recorder, part in self._parts():
            for seed in [seed for owner, seed in new if owner is recorder]:
                start = part.start + recorder.run.seeds.index(seed)
                self.progress.warn(_describe_divergence(recorder, seed, _slice(states, slice(start, start + 1))))
        is_debugging = jax.config.jax_debug_nans  # pyright: ignore[reportAttributeAccessIssue]
        if len(diverged) == self.batch.num_runs or is_debugging:
            reason = diverged[-1][0].reason[diverged[-1][1]]
            raise DivergedError(f"{reason}; training stopped", [recorder.rows for recorder in self.recorders])


def _describe_divergence(recorder: Recorder, seed: int, state: TrainState) -> str:
    """Save the frozen state, leaves [1, ...], and return one line about what diverged and how to replay it."""
    run = recorder.run
    if run.run_dir is None:
        return f"seed {seed} diverged and is frozen: {recorder.reason[seed]}"
    folder = divergence.save(run, seed, state)
    try:
        first = divergence.replay_update(folder, run.experiment).first
    except Exception as error:  # training of the other seeds continues
        first = f"unknown ({type(error).__name__})"
    replay = f'python -c "import jaxswarm; print(jaxswarm.replay_update({str(folder)!r}).first)"'
    return (
        f"seed {seed} of {run.run_dir} diverged and is frozen: {recorder.reason[seed]}; "
        f"non-finite first: {first}; replay that update with: {replay}"
    )


def _slice(states: Any, part: slice) -> Any:
    return jax.tree.map(lambda x: x[part], states)
