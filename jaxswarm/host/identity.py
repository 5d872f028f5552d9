"""Identity of a run, in its manifest and in each checkpoint: which run it is, its settings, and where it was trained.

Resuming compares it with the run folder, so that no file of another run and no edited setting changes results silently.
"""

import hashlib
import importlib.metadata
import inspect
import os
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

import jax


class Identity(TypedDict):
    """Identity of a run, as its checkpoints store it."""

    run_id: str
    config: dict[str, Any] | None  # of config.yaml; None: no config describes the run
    imports: dict[str, str]  # SHA-256 of the copies of user files, by name
    circumstances: dict[str, str | int | None]  # they may change results without a change of settings


def identify(
    run_id: str | None, config: Mapping[str, Any] | None, experiment: Any, imports: Mapping[str, str]
) -> Identity:
    """Return the identity of a run that is trained here and now; `None` as `run_id` stands for a new run."""
    return Identity(
        run_id=run_id or uuid.uuid4().hex,
        config=None if config is None else dict(config),
        imports=dict(imports),
        circumstances=circumstances(experiment),
    )


def circumstances(experiment: Any) -> dict[str, str | int | None]:
    """Return versions, device, number of CPU cores, and digests of the source files of the task and the network."""
    device = jax.devices()[0]
    versions = {name: _version(name) for name in ("jaxswarm", "jax", "jaxlib")}
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return versions | {
        "device": f"{device.platform} {device.device_kind}",
        "CPU cores": cores,
        "source of the task": _source_digest(type(experiment.task)),
        "source of the network": _source_digest(type(experiment.network)),
    }


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return one text for each circumstance that has changed, for example "jax 0.9.1 before, 0.10.0 now"."""
    return [
        f"{name} changed" if name.startswith("source") else f"{name} {before[name]} before, {now[name]} now"
        for name in now
        if name in before and before[name] != now[name]
    ]


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _source_digest(cls: type) -> str | None:
    """Return the SHA-256 of the file that defines a class; `None` for a class of a notebook."""
    try:
        return hashlib.sha256(Path(inspect.getfile(cls)).read_bytes()).hexdigest()
    except (OSError, TypeError):
        return None
