"""Checkpoints of training states: the latest few and the best, each written completely or not at all.

A checkpoint is a flat dict of NumPy arrays by dotted path (PRNG keys as their raw data), readable without this package
and on any device, beside a JSON record of everything else that resuming needs and the digests of its files. It is
written into a temporary folder and then renamed, so that other processes never see a part of one.
"""

import contextlib
import errno
import hashlib
import json
import logging
import math
import os
import re
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxswarm.files import replace_text, wait_for_space

_RECORD = Path("record", "metadata")  # where Orbax wrote the JSON record in version 0.1
_DIGESTS = "digests.json"
_OVERHEAD = 2**18  # bytes of a checkpoint besides its arrays
_NUM_FILES = 64  # of a checkpoint and its folders, at most


class CheckpointError(RuntimeError):
    """No checkpoint can be restored; the message says why."""


class _MismatchError(CheckpointError):
    """An intact checkpoint has other arrays than the settings of the run need."""


class Restored(NamedTuple):
    """The content of a checkpoint."""

    update: int
    train_state: Any
    record: dict[str, Any]
    score: float | None  # mean evaluation return of the policy, if it was evaluated
    identity: dict[str, Any] | None = None  # of the run, see `identity`; version 0.1 wrote none


class Checkpoints:
    """Write checkpoints into a directory from a separate thread, and remove those that are not kept.

    The directory's parent must exist. `identity` becomes part of every checkpoint.
    """

    def __init__(self, directory: Path, keep: int = 3, identity: Mapping[str, Any] | None = None):
        self._directory = directory.resolve()
        self._directory.mkdir(exist_ok=True)
        for leftover in self._directory.glob(".*.tmp"):
            shutil.rmtree(leftover, ignore_errors=True)
        self._keep = keep
        self._identity = identity
        self._scores = {update: _read_score(directory, update) for update in _updates(directory)}
        self._writer = ThreadPoolExecutor(1, "checkpoint")
        self._pending: Future = self._writer.submit(_warm_up)
        self.last_written = max(self._scores, default=0)  # update of the latest complete checkpoint

    @property
    def best_score(self) -> float:
        """Highest score on disk, -inf without a scored checkpoint."""
        return max((score for score in list(self._scores.values()) if score is not None), default=-np.inf)

    def save(self, update: int, train_state: Any, record: dict[str, Any], score: float | None) -> None:
        """Start writing a checkpoint, after waiting for the previous one. Updates must come in increasing order.

        `score` is the mean evaluation return of this policy, `None` if it was not evaluated. Raises the `OSError` of
        the previous checkpoint if it could not be written.
        """
        if self._scores.get(update) is not None or (score is None and update in self._scores):
            return
        arrays, key_impls = _to_arrays(train_state)
        record = {"run": record, "score": score, "key_impls": key_impls, "identity": self._identity}
        self._pending.result()
        self._scores[update] = score
        self._pending = self._writer.submit(self._write, update, arrays, record)

    def close(self) -> None:
        """Wait until all checkpoints are on disk; raises the `OSError` of a failed write."""
        self._writer.shutdown()
        self._pending.result()

    def _write(self, update: int, arrays: dict[str, np.ndarray], record: dict[str, Any]) -> None:
        def write(attempts: int = 5) -> None:
            self._directory.mkdir(exist_ok=True)
            try:
                _write(self._directory, update, arrays, record)
            except OSError as error:  # somebody may be deleting the directory
                if error.errno not in (errno.ENOENT, errno.EIO) or attempts == 1:
                    raise
                threading.Event().wait(0.2)
                write(attempts - 1)

        wait_for_space(write, self._directory.parent)
        self.last_written = update
        self._prune()

    def _prune(self) -> None:
        scored = [(score, update) for update, score in self._scores.items() if score is not None]
        best = max(scored, default=(None, None))[1]
        for update in sorted(self._scores)[: -self._keep]:
            if update != best:
                _remove(self._directory / str(update))
                del self._scores[update]


def restore(
    directory: Path,
    template: Any,
    which: Literal["last", "best"] = "last",
    on_damage: Callable[[str], None] = print,
    up_to: int | float = math.inf,
    run_id: str | None = None,
) -> Restored | None:
    """Restore the last or the best undamaged checkpoint of an update <= `up_to`; `None` if none was ever written.

    `template` is the abstract state, `jax.eval_shape(init, ...)`. `on_damage` gets one line for each damaged checkpoint
    that is skipped, and for each one of another run than `run_id`. Another process may train into the directory.

    Raises:
        CheckpointError: There are checkpoints but none can be restored, or an intact one does not fit the template.
    """
    skipped: set[int] = set()
    while updates := [update for update in _ordered(directory, which, up_to) if update not in skipped]:
        path = directory / str(updates[0])
        before = _version(path)
        try:
            return _restore(path, template, run_id)
        except _MismatchError:
            raise
        except Exception as error:  # a damaged file can raise anything
            if before == _version(path):  # otherwise, training has replaced or removed it meanwhile
                skipped.add(updates[0])
                reason = " ".join(str(error).split())[:200] or type(error).__name__
                on_damage(f"checkpoint {path} is damaged, trying another one: {reason}")
    if skipped:
        raise CheckpointError(f"none of the checkpoints in {directory} can be restored: {sorted(skipped)}")
    return None


def read_records(directory: Path) -> dict[int, dict[str, Any]]:
    """Return the JSON records of all undamaged checkpoints by update, in increasing order."""
    records = {}
    for update in sorted(_updates(directory)):
        with contextlib.suppress(OSError, ValueError, TypeError, AttributeError, RecursionError):
            records[update] = _verified_record(directory / str(update))
    return records


def set_aside(directory: Path, is_kept: Callable[[int], bool]) -> list[Path]:
    """Rename all checkpoints that are not kept, so that the run can write them again; return their old paths."""
    moved = []
    for update in sorted(_updates(directory)):
        if not is_kept(update):
            attempt = 0
            while (target := directory / f"damaged-{update}-{attempt}").exists():
                attempt += 1
            os.rename(directory / str(update), target)
            moved.append(directory / str(update))
    return moved


def _restore(path: Path, template: Any, run_id: str | None) -> Restored:
    record = _verified_record(path)
    identity = record.get("identity")
    if run_id is not None and (identity is None or identity["run_id"] != run_id):
        raise ValueError("it belongs to another run")
    with _orbax() as reader:
        arrays = reader.restore(path.resolve() / "state")
    arrays, key_impls = ({_current_name(name): x for name, x in old.items()} for old in (arrays, record["key_impls"]))
    train_state = _from_arrays(arrays, key_impls, template, path)
    return Restored(int(path.name), train_state, record["run"], record["score"], identity)


def _verified_record(path: Path) -> dict[str, Any]:
    """Return the JSON record of a checkpoint; raises a `ValueError` if one of its files has changed.

    Version 0.1 wrote the digests after the checkpoint, so that they are missing if it was killed in between.
    """
    content = (path / _RECORD).read_bytes()
    record = None
    if not (path / _DIGESTS).exists():
        record = json.loads(content)
        if record.get("identity") is not None:
            raise ValueError(f"{_DIGESTS} is missing")
    else:
        written, found = json.loads((path / _DIGESTS).read_text()), _digests(path)
        changed = [name for name in sorted({*written, *found}) if found.get(name) != written.get(name)]
        if changed:
            raise ValueError(f"{changed[0]} has changed since it was written")
    return json.loads(content) if record is None else record


def _write(directory: Path, update: int, arrays: dict[str, np.ndarray], record: dict[str, Any]) -> None:
    """Write a checkpoint completely, in place of an earlier one of this update."""
    temporary = directory / f".{update}.tmp"
    _require_space(directory, sum(x.nbytes for x in arrays.values()))
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        (temporary / _RECORD).parent.mkdir(parents=True)
        (temporary / _RECORD).write_text(json.dumps(record))
        with _orbax() as writer:
            writer.save(temporary / "state", {name: x for name, x in arrays.items() if x.size})
        replace_text(temporary / _DIGESTS, json.dumps(_digests(temporary)))
        _remove(directory / str(update))
        os.rename(temporary, directory / str(update))
    except Exception as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise _as_os_error(error, directory) from error


def _require_space(directory: Path, size: int) -> None:
    """Raise an `OSError` if the disk has no space for arrays of this size; Orbax prints tracebacks if it is full."""
    disk = os.statvfs(directory)
    is_short = disk.f_bavail * disk.f_frsize < 1.1 * size + _OVERHEAD
    if is_short or (disk.f_files and disk.f_favail < _NUM_FILES):  # some file systems have no fixed number of files
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(directory))


def _remove(path: Path) -> None:
    """Remove a checkpoint such that no other process sees a part of it."""
    if path.exists():
        removed = path.with_name(f".{path.name}.removed.tmp")
        shutil.rmtree(removed, ignore_errors=True)
        os.rename(path, removed)
        shutil.rmtree(removed, ignore_errors=True)


def _as_os_error(error: Exception, directory: Path) -> OSError:
    """Return the error of the operating system that stopped Orbax, which reports its number as text."""
    if isinstance(error, OSError) and error.errno:
        return error
    number = re.search(r"os_error_code='(\d+)'|OS error (\d+)", str(error))
    code = int(number[1] or number[2]) if number else errno.ENOENT if "NOT_FOUND" in str(error) else errno.EIO
    return OSError(code, os.strerror(code) if number else " ".join(str(error).split())[:200], str(directory))


def _warm_up() -> None:
    """Import Orbax, and silence its log of errors that it raises as well."""
    import orbax.checkpoint  # noqa: F401, PLC0415

    logging.getLogger("absl").addFilter(_is_no_background_error)


def _is_no_background_error(record: logging.LogRecord) -> bool:
    return "raised an exception" not in str(record.msg)


def _orbax() -> Any:
    """Return a checkpointer that does not wait for other processes, which do not write."""
    import orbax.checkpoint as ocp  # noqa: PLC0415

    me = jax.process_index()
    options = ocp.options.MultiprocessingOptions()
    if jax.process_count() > 1:
        options = ocp.options.MultiprocessingOptions(
            primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process_{me}"
        )
    handler = ocp.StandardCheckpointHandler(multiprocessing_options=options)
    return ocp.Checkpointer(handler, multiprocessing_options=options)


def _ordered(directory: Path, which: Literal["last", "best"], up_to: int | float) -> list[int]:
    """Return the updates of all checkpoints, the wanted one first.

    If there is none but a temporary folder, a checkpoint may be about to be renamed: wait for it.
    """
    for _ in range(20):
        updates = sorted((update for update in _updates(directory) if update <= up_to), reverse=True)
        if updates or not any(directory.glob(".*.tmp")):
            break
        threading.Event().wait(0.05)
    if which == "best":
        scores = {update: _read_score(directory, update) for update in updates}
        updates.sort(key=lambda update: (scores[update] is not None, scores[update] or 0.0), reverse=True)
    return updates


def _updates(directory: Path) -> list[int]:
    return [int(path.name) for path in directory.glob("[0-9]*") if path.name.isdecimal() and path.is_dir()]


def _version(path: Path) -> int | None:
    """Return a number that identifies this copy of a checkpoint; `None` if it does not exist."""
    try:
        return path.stat().st_ino
    except OSError:
        return None


def _read_score(directory: Path, update: int) -> float | None:
    try:
        score = json.loads((directory / str(update) / _RECORD).read_text())["score"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return score if isinstance(score, float) else None


def _digests(path: Path) -> dict[str, str]:
    """Return the SHA-256 of every file of a checkpoint but hidden ones, by name."""
    files = sorted(file for file in path.rglob("[!.]*") if file.is_file() and file.name != _DIGESTS)
    return {str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def _current_name(path: str) -> str:
    """Translate the path of a leaf that version 0.1 wrote."""
    first, dot, rest = path.partition(".")
    return f"envs{dot}{'is_complete' if rest == 'is_whole' else rest}" if first == "worlds" else path


def _named_leaves(tree: Any) -> Iterator[tuple[str, Any]]:
    for path, leaf in jax.tree.leaves_with_path(tree):
        yield jax.tree_util.keystr(path, simple=True, separator="."), leaf


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_arrays(tree: Any) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return host copies of all leaves by path, and the implementations of those that are PRNG keys."""
    leaves = dict(_named_leaves(tree))
    keys = {name: str(jax.random.key_impl(leaf)) for name, leaf in leaves.items() if _is_key(leaf)}
    raw = {name: jax.random.key_data(leaf) if name in keys else leaf for name, leaf in leaves.items()}
    return {name: np.array(x) for name, x in jax.device_get(raw).items()}, keys


def _from_arrays(arrays: dict[str, np.ndarray], key_impls: dict[str, str], template: Any, path: Path) -> Any:
    """Return the tree of `template` with these leaves; raises a `_MismatchError` if they do not fit."""
    leaves = []
    for name, expected in _named_leaves(template):
        if not expected.size:
            arrays[name] = np.zeros(expected.shape, expected.dtype)  # Orbax does not write empty arrays
        if name not in arrays:
            raise _MismatchError(f"checkpoint {path} has no {name}, so it belongs to another experiment or version")
        array = arrays[name]
        leaf = jax.random.wrap_key_data(jnp.asarray(array), impl=key_impls[name]) if name in key_impls else array
        if (leaf.shape, leaf.dtype) != (expected.shape, expected.dtype):
            found, wanted = (f"{x.dtype}{list(x.shape)}" for x in (leaf, expected))
            hint = f"; set JAX_DEFAULT_PRNG_IMPL={key_impls[name]}" if name in key_impls else ""
            raise _MismatchError(f"checkpoint {path}: {name} is {found}, but these settings need {wanted}{hint}")
        leaves.append(jnp.asarray(leaf))
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
