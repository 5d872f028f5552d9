"""Run folders: search, reading, and groups of runs with equal settings, labeled by the settings that differ."""

import contextlib
import dataclasses
import json
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxswarm import config as configs
from jaxswarm.analysis import curves
from jaxswarm.analysis.curves import Curve
from jaxswarm.config import ConfigError, schema
from jaxswarm.files import Row, read_rows

# keys that change neither a task nor a policy: seed, length, checkpoints, and times of evaluation
NOT_COMPARED = {"eval_every", *(field.name for field in dataclasses.fields(configs.RunSettings))} - {configs.INIT_FROM}

Fields = dict[str, Any]  # a config by dotted keys, without those in NOT_COMPARED


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Content of a run folder, which holds one or more seeds: config and evaluations."""

    path: Path
    config: Fields
    rows: list[Row]


def find(paths: Sequence[Path]) -> list[Path]:
    """Return all run folders at or below the paths, each once. Raise a `ConfigError` for a path without run folders."""
    found: dict[Path, Path] = {}
    for path in paths:
        if not path.is_dir():
            raise ConfigError(f"PATH: must be a run folder or a folder that contains run folders, got {str(path)!r}")
        folders = list(_run_folders(path))
        if not folders:
            raise ConfigError(f"{path} contains no run folder, which is a folder with config.yaml and metrics.csv")
        found |= {folder.resolve(): folder for folder in folders}
    return list(found.values())


def read(path: Path) -> RunFolder:
    """Read config and evaluations of a run folder. Raise a `ConfigError` that names the file if one is invalid."""
    nested = configs.read(path / "config.yaml")
    with contextlib.suppress(ConfigError):  # a config of another version is used unchanged
        nested = configs.validate(nested)
    try:
        rows = read_rows(path / "metrics.csv")
    except ValueError as error:
        raise ConfigError(f"cannot read {path / 'metrics.csv'}: {error}") from error
    missing = [name for name in ("update", "agent_steps", "seed") if rows and name not in rows[0]]
    if missing:
        raise ConfigError(f"cannot read {path / 'metrics.csv'}: the file has no column {missing[0]}")
    flat = fields(nested)
    if isinstance(num_agents := flat.get("task.num_agents"), int):
        rows = [{"env_steps": row["agent_steps"] // num_agents} | row for row in rows]  # absent before version 0.2
    return RunFolder(path, flat, rows)


def fields(config: configs.Config) -> Fields:
    """Flatten a config to dotted keys, without the keys that are not compared."""
    return {name: x for name, x in configs.flat(config).items() if name not in NOT_COMPARED}


def group(folders: Sequence[RunFolder], keys: Sequence[str] = ()) -> dict[str, list[RunFolder]]:
    """Group folders whose compared settings are equal.

    The keys of the result are labels: the settings that differ between groups, or those in `keys`
    (full keys). Raises a `ConfigError` if `keys` give two groups the same label.
    """
    by_settings = defaultdict(list)
    for folder in folders:
        by_settings[json.dumps(folder.config, sort_keys=True)].append(folder)
    groups = list(by_settings.values())
    all_fields = [members[0].config for members in groups]
    if keys:
        texts = [settings(key, all_fields) for key in keys]
        labels = [", ".join(parts) for parts in zip(*texts, strict=True)]
        twice = next((text for text in labels if labels.count(text) > 1), None)
        if twice is not None:
            same = [repr(full) for full, text in zip(label(all_fields), labels, strict=True) if text == twice]
            raise ConfigError(f"labels: must differ between groups, got {twice!r} for {' and '.join(same)}")
    else:
        labels = label(all_fields)
    return dict(sorted(zip(labels, groups, strict=True), key=lambda pair: by_number(pair[0])))


def each_run(folders: Sequence[RunFolder]) -> dict[str, list[RunFolder]]:
    """Return a group for each folder, labeled by the shortest end of its path that no other folder has."""
    names = shortened([str(folder.path.resolve()) for folder in folders])
    return {names[str(folder.path.resolve())]: [folder] for folder in folders}


def resolve(option: str, key: str, all_fields: Sequence[Fields]) -> str:
    """Return the full key of a setting: `learner.learning_rate` for `learning_rate`, `task.name` for `task`.

    Raises a `ConfigError` about the option if no config has the key, or if several parts have it.
    """
    known = list(dict.fromkeys(name for fields in all_fields for name in fields))
    found = [name for name in (key, f"{key}.name") if name in known][:1]
    found = found or [name for name in known if name.rpartition(".")[2] == key != "name"]
    if len(found) == 1:
        return found[0]
    accepted = f"one of {', '.join(found)}" if found else f"a key of the runs{schema.nearest(key, known)}"
    raise ConfigError(f"{option}: must be {accepted}, got {key!r}")


def settings(key: str, all_fields: Sequence[Fields]) -> list[str]:
    """Return a setting of each config as "key=value", without the name of its part. Absolute paths are shortened."""
    values = [_text(fields[key]) if key in fields else "unset" for fields in _with_short_paths(all_fields)]
    return [f"{_short(key, {key})}={value}" for value in values]


def shortened(paths: Sequence[str]) -> dict[str, str]:
    """Return the shortest ends of the paths that differ where the paths differ."""
    distinct = list(dict.fromkeys(paths))
    longest = max((len(Path(path).parts) for path in distinct), default=1)
    for size in range(1, longest + 1):
        ends = {path: str(Path(*Path(path).parts[-size:])) for path in distinct}
        if len(set(ends.values())) == len(distinct):
            return ends
    return {path: path for path in distinct}


def label(configs_of_groups: Sequence[Fields]) -> list[str]:
    """Return a label for each of several different configs: the settings that differ, as "key=value, ...".

    If a part such as the aggregator differs, the label has only its name, and its fields only if parts of the same
    name differ. If several fields of the network differ and every group uses a preset, the label has the name of the
    preset. Absolute paths are shortened. The label of a single group is the names of its parts.
    """
    if len(configs_of_groups) == 1:
        return [common_name(configs_of_groups) or "runs"]
    configs_of_groups = _with_short_paths(configs_of_groups)
    texts = [_differences(fields, configs_of_groups) for fields in configs_of_groups]
    presets = _network_presets(configs_of_groups)
    if presets:
        kept = [{key: x for key, x in text.items() if not key.startswith("network.")} for text in texts]
        texts = [text | {"network": preset} for text, preset in zip(kept, presets, strict=True)]
    keys = {key for text in texts for key in text}
    return [", ".join(f"{_short(key, keys)}={value}" for key, value in text.items()) for text in texts]


def common_name(configs_of_groups: Sequence[Fields]) -> str:
    """Return the names of the parts that all configs share, such as "rendezvous, mean, ppo"."""
    names = [{fields.get(f"{part}.name") for fields in configs_of_groups} for part in configs.REGISTERED]
    return ", ".join(name for choices in names if len(choices) == 1 for name in choices if name)


def seeds(
    folders: Sequence[RunFolder], x: str, y: str, warn: Callable[[str], object], *, once: bool = False
) -> list[Curve]:
    """Return a curve for each seed of a group.

    A seed that two folders hold with equal values (a copy or a resumed run) counts once, and the longer curve is used.
    With `once`, a seed also counts once if its values differ, as they may between devices. `warn` is called with one
    line for everything that is left out and for each seed that occurs more than once.
    """
    kept: dict[int, list[_Seed]] = defaultdict(list)
    for folder in folders:
        mine, num_left_out = curves.from_rows(folder.rows, x, y)
        if num_left_out:
            warn(f"{folder.path}: number of evaluations left out because {y} is not finite: {num_left_out}")
        absent = sorted({row["seed"] for row in folder.rows} - mine.keys())
        if absent or not folder.rows:
            missing = f"seed {', '.join(map(str, absent))}" if absent else "the run"
            warn(f"{folder.path}: left out {missing} without a finite {y}")
        by_update, _ = curves.from_rows(folder.rows, "update", y)
        for number, curve in mine.items():
            seed = _Seed(folder.path, by_update[number], curve)
            same = next((i for i, other in enumerate(kept[number]) if once or seed.is_same(other)), None)
            if same is None:
                kept[number].append(seed)
                continue
            other = kept[number][same]
            warn(f"{folder.path}: seed {number} is also in {other.path}; only the longer one is counted")
            kept[number][same] = max(other, seed, key=lambda one: one.by_update.x[-1])
    for number, several in kept.items():
        if len(several) > 1:
            names = ", ".join(str(seed.path) for seed in several)
            warn(f"seed {number} occurs {len(several)} times with different values; each one is counted: {names}")
    return [seed.curve for several in kept.values() for seed in several]


class _Seed(NamedTuple):
    """Curve of a seed of a folder: over updates, for comparison, and over the requested column."""

    path: Path
    by_update: Curve
    curve: Curve

    def is_same(self, other: "_Seed") -> bool:
        """Return whether both have equal values at all updates at which both were evaluated."""
        _, mine, others = np.intersect1d(self.by_update.x, other.by_update.x, return_indices=True)
        return mine.size > 0 and np.array_equal(self.by_update.y[mine], other.by_update.y[others])


def _run_folders(path: Path) -> Iterator[Path]:
    for folder, below, files in os.walk(path):
        if "config.yaml" in files and ("metrics.csv" in files or "manifest.json" in files):
            below.clear()
            yield Path(folder)
        below.sort()


def _differences(fields: Fields, all_fields: Sequence[Fields]) -> dict[str, str]:
    """Return the settings that differ from other configs. Fields of a part are compared only if its name is equal."""
    texts = {}
    for key in dict.fromkeys(key for other in all_fields for key in other):
        name = f"{key.partition('.')[0]}.name"
        peers = [other for other in all_fields if key == name or other.get(name) == fields.get(name)]
        values = [_text(other[key]) if key in other else "unset" for other in (fields, *peers)]
        if len(set(values)) > 1:
            texts[key] = values[0]
    return texts


def _with_short_paths(all_fields: Sequence[Fields]) -> list[Fields]:
    """Return the configs with absolute paths, such as that of a warm start, shortened to ends that differ."""
    paths = [{key: x for key, x in fields.items() if isinstance(x, str) and os.path.isabs(x)} for fields in all_fields]
    ends = {key: shortened([own[key] for own in paths if key in own]) for key in {key for own in paths for key in own}}
    return [
        fields | {key: ends[key][path] for key, path in own.items()}
        for fields, own in zip(all_fields, paths, strict=True)
    ]


def _network_presets(all_fields: Sequence[Fields]) -> list[str] | None:
    """Return the names of the network presets if several network fields differ and each config uses a preset."""
    keys = {key for fields in all_fields for key in fields if key.startswith("network.")}
    keys = {key for key in keys if any(other.get(key) != all_fields[0].get(key) for other in all_fields)}
    if len(keys) < 2:
        return None
    values = {choice: configs.preset("network", choice) for choice in configs.choices()["network"]}
    names = []
    for fields in all_fields:
        wanted: Mapping[str, Any] = {key.partition(".")[2]: fields.get(key) for key in keys}
        fitting = [choice for choice, preset in values.items() if wanted.items() <= preset.items()]
        names += fitting[-1:]  # the last alias: "small", not "simple"
    return names if len(names) == len(all_fields) else None


def _short(key: str, keys: set[str]) -> str:
    """Return the key without its part if this is unambiguous."""
    leaf = key.rpartition(".")[2]
    if leaf == "name":
        return key.partition(".")[0]
    return leaf if [other.rpartition(".")[2] for other in keys].count(leaf) == 1 else key


def _text(value: Any) -> str:
    """Return the value as a user types it on the command line."""
    if isinstance(value, float):
        return f"{value:g}"
    return json.dumps(value, separators=(",", ":")).strip('"')


def by_number(text: str) -> list[str | float]:
    """Return a sort key that orders numbers in the text by size."""
    parts = re.split(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)", text)
    return [float(part) if number % 2 else part for number, part in enumerate(parts)]
