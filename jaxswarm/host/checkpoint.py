"""Checkpoints of training states: the latest few and the best, each written completely or not at all.

A checkpoint is a flat dict of NumPy arrays by dotted path (PRNG keys as their raw data), readable without this package
and on any device, beside a JSON record of everything else that resuming needs. Digests of its files are added once it
is complete, so that damage is detected before anything is read.
"""

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxswarm.files import replace_text

_RECORD = Path("record", "metadata")  # where Orbax writes the JSON record
_DIGESTS = "digests.json"


class CheckpointError(RuntimeError):
    """No checkpoint can be restored; the message says why."""


class Restored(NamedTuple):
    """The content of a checkpoint."""

    update: int
    train_state: Any
    record: dict[str, Any]
    score: float | None  # mean evaluation return of the policy, if it was evaluated


class Checkpoints:
    """Write checkpoints into a directory from a separate thread, and remove those that are not kept."""

    def __init__(self, directory: Path, keep: int = 3):
        self._directory = directory.resolve()
        self._directory.mkdir(parents=True, exist_ok=True)
        self._keep = keep
        self._scores = {update: _read_score(directory, update) for update in _updates(directory)}
        self._writer = ThreadPoolExecutor(1, "checkpoint")
        self._pending: Future = self._writer.submit(self._open)

    @property
    def best_score(self) -> float:
        """Highest score on disk, -inf without a scored checkpoint."""
        return max((score for score in list(self._scores.values()) if score is not None), default=-np.inf)

    def save(self, update: int, train_state: Any, record: dict[str, Any], score: float | None) -> None:
        """Start writing a checkpoint, after waiting for the previous one. Updates must come in increasing order.

        `score` is the mean evaluation return of this policy, `None` if it was not evaluated.
        """
        if self._scores.get(update) is not None or (score is None and update in self._scores):
            return
        arrays, key_impls = _to_arrays(train_state)
        record = {"run": record, "score": score, "key_impls": key_impls}
        self._pending.result()
        self._scores[update] = score
        self._pending = self._writer.submit(self._write, update, arrays, record)

    def close(self) -> None:
        """Wait until all checkpoints are on disk; raises the error of a failed write."""
        self._writer.submit(self._close)
        self._writer.shutdown()
        self._pending.result()

    def _open(self) -> None:
        import orbax.checkpoint as ocp  # noqa: PLC0415

        options = ocp.CheckpointManagerOptions(
            max_to_keep=None,
            create=False,
            cleanup_tmp_directories=any(
                self._directory.iterdir()
            ),  # this directory outlives a manager that saves nothing
            enable_async_checkpointing=False,
            multiprocessing_options=_single_process_options(),
        )
        self._manager = ocp.CheckpointManager(self._directory, options=options)

    def _close(self) -> None:
        self._manager.close()

    def _write(self, update: int, arrays: dict[str, np.ndarray], record: dict[str, Any]) -> None:
        import orbax.checkpoint as ocp  # noqa: PLC0415

        if update in self._manager.all_steps():
            self._manager.delete(update)  # it was written before its evaluation was known
        state = ocp.args.StandardSave({name: x for name, x in arrays.items() if x.size})
        self._manager.save(update, args=ocp.args.Composite(state=state, record=ocp.args.JsonSave(record)))
        path = self._directory / str(update)
        replace_text(path / _DIGESTS, json.dumps(_digests(path)))
        self._prune()

    def _prune(self) -> None:
        scored = [(score, update) for update, score in self._scores.items() if score is not None]
        best = max(scored, default=(None, None))[1]
        for update in sorted(self._scores)[: -self._keep]:
            if update != best:
                self._manager.delete(update)
                del self._scores[update]


def restore(
    directory: Path,
    template: Any,
    which: Literal["last", "best"] = "last",
    on_damage: Callable[[str], None] = print,
    up_to: int | float = math.inf,
) -> Restored | None:
    """Restore the last or the best undamaged checkpoint of an update <= `up_to`; `None` if none was ever written.

    `template` is the abstract state, `jax.eval_shape(init, ...)`. `on_damage` gets one line for each damaged checkpoint
    that is skipped. Raises a `CheckpointError` if there are checkpoints but none can be restored.
    """
    updates = sorted((update for update in _updates(directory) if update <= up_to), reverse=True)
    if which == "best":
        scores = {update: _read_score(directory, update) for update in updates}
        updates.sort(key=lambda update: (scores[update] is not None, scores[update] or 0.0), reverse=True)
    for update in updates:
        try:
            return _restore(directory, update, template)
        except Exception as error:  # a damaged file can raise anything
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            on_damage(f"checkpoint {directory / str(update)} is damaged, trying another one: {reason}")
    if updates:
        raise CheckpointError(f"none of the checkpoints in {directory} can be restored: {sorted(updates)}")
    return None


def set_aside_after(directory: Path, update: int) -> None:
    """Rename checkpoints of later updates, which could not be restored, so that the run can write them again."""
    for later in _updates(directory):
        if later > update:
            attempt = 0
            while (target := directory / f"damaged-{later}-{attempt}").exists():
                attempt += 1
            os.rename(directory / str(later), target)


def _restore(directory: Path, update: int, template: Any) -> Restored:
    import orbax.checkpoint as ocp  # noqa: PLC0415

    path = (directory / str(update)).resolve()
    record = json.loads((path / _RECORD).read_text())
    if (path / _DIGESTS).exists():  # missing if the run was killed right after the checkpoint was completed
        written, found = json.loads((path / _DIGESTS).read_text()), _digests(path)
        changed = [name for name, digest in written.items() if found.get(name) != digest]
        if changed:
            raise ValueError(f"{changed[0]} has changed since it was written")
    with ocp.StandardCheckpointer(multiprocessing_options=_single_process_options()) as reader:
        arrays = reader.restore(path / "state")
    arrays, key_impls = ({_current_name(name): x for name, x in old.items()} for old in (arrays, record["key_impls"]))
    train_state = _from_arrays(arrays, key_impls, template)
    return Restored(update, train_state, record["run"], record["score"])


def _current_name(path: str) -> str:
    """Translate the path of a leaf that version 0.1 wrote."""
    first, dot, rest = path.partition(".")
    return f"envs{dot}{'is_complete' if rest == 'is_whole' else rest}" if first == "worlds" else path


def _single_process_options() -> Any:
    """Return options that keep Orbax from waiting for other processes, which do not write."""
    import orbax.checkpoint as ocp  # noqa: PLC0415

    me = jax.process_index()
    if jax.process_count() == 1:
        return ocp.options.MultiprocessingOptions()
    return ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process_{me}"
    )


def _updates(directory: Path) -> list[int]:
    return [int(path.name) for path in directory.glob("[0-9]*") if path.name.isdigit()]


def _read_score(directory: Path, update: int) -> float | None:
    try:
        return json.loads((directory / str(update) / _RECORD).read_text())["score"]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _digests(path: Path) -> dict[str, str]:
    """Return the SHA-256 of every file of a checkpoint, by name."""
    files = sorted(file for file in path.rglob("*") if file.is_file() and _DIGESTS not in file.name)
    return {str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


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


def _from_arrays(arrays: dict[str, np.ndarray], key_impls: dict[str, str], template: Any) -> Any:
    """Return the tree of `template` with these leaves."""
    leaves = []
    for name, expected in _named_leaves(template):
        if not expected.size:
            arrays[name] = np.zeros(expected.shape, expected.dtype)  # Orbax does not write empty arrays
        if name not in arrays:
            raise ValueError(f"it has no {name}, so it belongs to another experiment or version")
        leaf = jnp.asarray(arrays[name])
        if name in key_impls:
            leaf = jax.random.wrap_key_data(leaf, impl=key_impls[name])
        if (leaf.shape, leaf.dtype) != (expected.shape, expected.dtype):
            raise ValueError(f"its {name} is {leaf.dtype}{leaf.shape}, not {expected.dtype}{expected.shape}")
        leaves.append(leaf)
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
