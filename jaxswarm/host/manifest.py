"""Manifest of a run, `manifest.json`: versions, device, code revision, and exact numbers of steps."""

import importlib.metadata
import json
import math
import platform
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from jaxswarm.files import read_text, replace_text
from jaxswarm.learners.on_policy import OnPolicy, batch_size

PACKAGES = ("jaxswarm", "jax", "jaxlib", "flax", "optax", "distrax", "orbax-checkpoint", "numpy")


def describe(experiment: Any, num_updates: int, seeds: Sequence[int]) -> dict[str, Any]:
    """Return the content of the manifest, as values that JSON can store.

    It contains the start time, the command, the seeds, all numbers of steps that follow from the experiment, and
    `provenance`.
    """
    per_update = experiment.agent_steps_per_update
    steps = {
        "updates": num_updates,
        "num_agents": experiment.task.num_agents,
        "num_envs": experiment.num_envs,
        "steps_per_env_and_update": experiment.num_steps,
        "environment_steps_per_update": experiment.num_envs * experiment.num_steps,
        "agent_steps_per_update": per_update,
        "environment_steps": num_updates * experiment.num_envs * experiment.num_steps,
        "agent_steps": num_updates * per_update,
        "evaluations": math.ceil(num_updates / experiment.eval_every) + 1,
        "episodes_per_evaluation": experiment.num_eval_envs,
    }
    if isinstance(experiment.learner, OnPolicy):
        size = batch_size(experiment.learner, per_update, experiment.task.num_agents)
        gradient_steps = experiment.learner.num_epochs * per_update // size
        steps |= {
            "samples_per_gradient_step": size,
            "gradient_steps_per_update": gradient_steps,
            "gradient_steps": num_updates * gradient_steps,
        }
    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": sys.argv,
        "seeds": list(seeds),
        "steps": steps,
    } | provenance()


def provenance() -> dict[str, Any]:
    """Return the versions of packages, the platform, the device, and the Git revision of the code."""
    device = jax.devices()[0]
    return {
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES},
        "platform": f"{platform.system()} {platform.machine()}",
        "device": {"backend": device.platform, "kind": device.device_kind, "count": jax.device_count()},
        "git_revision": _git_revision(),
    }


def write_manifest(path: Path, content: dict[str, Any]) -> None:
    """Write the manifest. A resumed run keeps the manifests of its earlier sessions under `earlier_sessions`."""
    previous = read_manifest(path)
    if previous:
        earlier = previous.pop("earlier_sessions", [])
        content = content | {"earlier_sessions": [*(earlier if isinstance(earlier, list) else []), previous]}
    replace_text(path, json.dumps(content, indent=2) + "\n")


def read_manifest(path: Path) -> dict[str, Any]:
    """Return the content of a manifest; one that is missing or damaged is empty."""
    try:
        content = json.loads(read_text(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_revision() -> str | None:
    """Return the commit of the checkout that contains this package, marked "-dirty" if tracked files differ from it.

    Return `None` outside of a checkout.
    """
    checkout = Path(__file__).resolve().parent.parent.parent
    if not (checkout / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
