"""The points that runs resume from, verified: the checkpoints, settings and rows must belong to the same run.

What can be restored is restored, with one line of warning. Anything else is refused, unless `force` continues anyway.
"""

import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxswarm import files
from jaxswarm.config import ConfigError, plugins
from jaxswarm.host import identity
from jaxswarm.host.checkpoint import Restored, read_records, restore, set_aside
from jaxswarm.host.ensemble import abstract_state, broadcast_from_first
from jaxswarm.host.manifest import read_manifest
from jaxswarm.host.metrics_log import verified_lines
from jaxswarm.host.run import Run, changed_settings, read_rows


class ResumePoint(NamedTuple):
    """State that a run resumes from."""

    restored: Restored
    lines: list[str]  # of metrics.csv: the header and the rows of earlier updates
    changes: list[str]  # of circumstances since the checkpoint, such as versions


def resume_command(run_dir: Path, *options: str) -> str:
    """Return the shell command that resumes a run."""
    return shlex.join(["jaxswarm-train", f"resume={run_dir}", *options])


def resume_points(runs: Sequence[Run], force: bool = False) -> list[ResumePoint] | None:
    """Restore and verify each run at the last update of which all have a checkpoint; `None` if one of them has none.

    Raises a `ConfigError` if settings or rows have changed and `force` is false, and a `CheckpointError` if no
    checkpoint can be restored.
    """
    run_ids = [None if force else _run_id(run.folder) for run in runs]
    up_to = math.inf
    while True:
        found = [_restore(run, run_id, up_to) for run, run_id in zip(runs, run_ids, strict=True)]
        updates = {one.update if one else -1 for one in found}
        if len(updates) == 1 or -1 in updates:
            break
        up_to = min(updates)
    broadcast_from_first(0)  # waits until every process has finished reading
    if jax.process_index() == 0:
        for run, one in zip(runs, found, strict=True):
            _set_aside(run.folder, min(updates), one)
    complete = [one for one in found if one]
    if len(complete) < len(runs):
        return None
    return [_verified(run, one, force) for run, one in zip(runs, complete, strict=True)]


def final_lines(run: Run, restored: Restored) -> list[str]:
    """Return the lines of `metrics.csv` of a run that has reached its end, restored from its copy if necessary."""
    digest = restored.record.get("final_rows")
    lines = None if digest is None else verified_lines(run.folder, digest, _warn)
    return files.format_rows(read_rows(run.folder)) if lines is None else lines


def _restore(run: Run, run_id: str | None, up_to: int | float) -> Restored | None:
    template = abstract_state(run.experiment, len(run.seeds))
    return restore(run.folder / "checkpoints", template, on_damage=_warn, up_to=up_to, run_id=run_id)


def _run_id(run_dir: Path) -> str | None:
    """Return the identity of the run in a folder, by its manifest or else by its newest checkpoint.

    Returns `None` without checkpoints, and after a warning if version 0.1 wrote them.
    """
    records = read_records(run_dir / "checkpoints")
    found = [record["identity"]["run_id"] for record in records.values() if record.get("identity")]
    if not found:
        if records:
            _warn(f"{run_dir} was written by jaxswarm 0.1, without identity; its files cannot be verified")
        return None
    in_manifest = read_manifest(run_dir / "manifest.json").get("run_id")
    if in_manifest in found:
        return in_manifest
    _warn(f"{run_dir / 'manifest.json'} is missing, damaged or of another run; it is written again")
    return found[-1]


def _set_aside(run_dir: Path, update: int, restored: Restored | None) -> None:
    """Rename checkpoints that are damaged, of another run, or of later updates."""
    run_id = restored.identity["run_id"] if restored and restored.identity else None
    own = {
        number
        for number, record in read_records(run_dir / "checkpoints").items()
        if run_id is None or (record.get("identity") or {}).get("run_id") == run_id
    }
    for path in set_aside(run_dir / "checkpoints", lambda number: number in own and number <= update):
        if int(path.name) < update:
            _warn(f"checkpoint {path} is damaged or of another run, and is set aside; it may have been the best one")


def _verified(run: Run, restored: Restored, force: bool) -> ResumePoint:
    stored = restored.identity
    if stored is None:
        rows = [row for row in read_rows(run.folder) if row["update"] < restored.update]
        return ResumePoint(restored, files.format_rows(rows), [])
    if stored["config"] is not None and run.config is not None:
        _check_settings(run, stored["config"], run.config, force)
    _check_imports(run, stored["imports"], force)
    lines = verified_lines(run.folder, restored.record["rows"], _warn)
    if lines is None:
        _refuse(run, f"{run.folder / 'metrics.csv'} and its copy have been changed or damaged", "the rows left", force)
        rows = [row for row in read_rows(run.folder) if row["update"] < restored.update]
        lines = files.format_rows(rows)
    changes = identity.changes(stored["circumstances"], identity.circumstances(run.experiment))
    if changes:
        _warn(f"{run.folder}: {'; '.join(changes)}; results may differ in their last bits")
    return ResumePoint(restored, lines, changes)


def _check_imports(run: Run, stored: Mapping[str, str], force: bool) -> None:
    originals = (run.config or {}).get("imports", [])
    for (name, digest), original in zip(stored.items(), originals, strict=False):
        copy = run.folder / "imports" / name
        if not plugins.has_run(digest, copy, original):
            _refuse(run, f"the code of {copy} has been changed since the checkpoint", "the changed code", force)


def _check_settings(run: Run, stored: Mapping[str, Any], now: Mapping[str, Any], force: bool) -> None:
    changed = changed_settings(stored, now)
    if changed:
        name, (before, after) = next(iter(changed.items()))
        more = f" (and {len(changed) - 1} more)" if len(changed) > 1 else ""
        where = run.folder / "config.yaml"
        hint = f"; to train its policy with other settings: jaxswarm-train init_from={run.folder} {name}={after}"
        text = f"{name}: {before} in the checkpoint, {after} in {where}{more}; undo the change"
        _refuse(run, text + hint, "the new settings", force)


def _refuse(run: Run, text: str, continuing: str, force: bool) -> None:
    """Raise a `ConfigError` that says how to continue anyway; with `force`, continue after a warning."""
    if not force:
        command = resume_command(run.folder, "force=true")
        raise ConfigError(f"{text}; to continue with {continuing}: {command}")
    _warn(text)


def _warn(text: str) -> None:
    if jax.process_index() == 0:
        print(f"warning: {text}", file=sys.stderr, flush=True)
