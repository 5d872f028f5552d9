"""Run folders: found, read, and put into groups of seeds that are named by what their configs do not share."""

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
from jaxswarm.config import ConfigError
from jaxswarm.files import Row, read_rows

# keys that change neither a world nor a policy: seed, length, checkpoints, and when to look
NOT_COMPARED = {"eval_every", *(field.name for field in dataclasses.fields(configs.RunSettings))} - {configs.INIT_FROM}

Fields = dict[str, Any]  # a config by dotted key, without those that are not compared


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """What a run left behind, of one seed or of several."""

    path: Path
    config: Fields
    rows: list[Row]


def find(paths: Sequence[Path]) -> list[Path]:
    """All run folders at or below the paths, each once; a `ConfigError` for a path without any."""
    found: dict[Path, Path] = {}
    for path in paths:
        if not path.is_dir():
            raise ConfigError(f"{path} is not a folder: give run folders, or folders that contain run folders")
        here = list(_run_folders(path))
        if not here:
            raise ConfigError(f"{path} contains no run folder, that is a folder with config.yaml and metrics.csv")
        found |= {folder.resolve(): folder for folder in here}
    return list(found.values())


def read(path: Path) -> RunFolder:
    """Reads config and evaluations; a `ConfigError` says which file is not what it should be."""
    nested = configs.read(path / "config.yaml")
    with contextlib.suppress(ConfigError):  # the config of another version stays as it is
        nested = configs.validate(nested)
    try:
        rows = read_rows(path / "metrics.csv")
    except ValueError as error:
        raise ConfigError(f"cannot read {path / 'metrics.csv'}: {error}") from error
    missing = [name for name in ("update", "agent_steps", "seed") if rows and name not in rows[0]]
    if missing:
        raise ConfigError(f"cannot read {path / 'metrics.csv'}: it has no column {missing[0]}")
    return RunFolder(path, fields(nested), rows)


def fields(config: configs.Config) -> Fields:
    """A config as `Fields`."""
    return {name: x for name, x in configs.flat(config).items() if name not in NOT_COMPARED}


def group(folders: Sequence[RunFolder]) -> dict[str, list[RunFolder]]:
    """Folders whose configs agree in what is compared, by a label of what the groups do not agree in."""
    groups = defaultdict(list)
    for folder in folders:
        groups[json.dumps(folder.config, sort_keys=True)].append(folder)
    labels = label([members[0].config for members in groups.values()])
    return dict(sorted(zip(labels, groups.values(), strict=True), key=lambda pair: _by_number(pair[0])))


def label(configs_of_groups: Sequence[Fields]) -> list[str]:
    """A name for each of several different configs: the values that differ, or the names of parts that do.

    Of a part such as the aggregator its name is enough, unless groups with the same name differ, too. Several fields
    of the network are given as the name of a preset if all groups use one. A single group is called by its parts.
    """
    if len(configs_of_groups) == 1:
        return [common_name(configs_of_groups) or "runs"]
    texts = [_differences(fields, configs_of_groups) for fields in configs_of_groups]
    presets = _network_presets(configs_of_groups)
    if presets:
        kept = [{key: x for key, x in text.items() if not key.startswith("network.")} for text in texts]
        texts = [text | {"network": preset} for text, preset in zip(kept, presets, strict=True)]
    keys = {key for text in texts for key in text}
    return [", ".join(f"{_short(key, keys)}={value}" for key, value in text.items()) for text in texts]


def common_name(configs_of_groups: Sequence[Fields]) -> str:
    """Names of the parts that all configs share, like `rendezvous, mean, ppo`."""
    names = [{fields.get(f"{part}.name") for fields in configs_of_groups} for part in configs.REGISTERED]
    return ", ".join(name for choices in names if len(choices) == 1 for name in choices if name)


def seeds(
    folders: Sequence[RunFolder], x: str, y: str, warn: Callable[[str], object], *, once: bool = False
) -> list[Curve]:
    """A curve for each seed of a group.

    A seed that two folders hold with the same numbers, as a copy or a longer run does, counts once; with `once` also
    one that they hold with other numbers, as two devices may give. The longer one is counted. What is left out, and
    seeds that occur more than once, are told to `warn`, one line each.
    """
    kept: dict[int, list[_Seed]] = defaultdict(list)
    for folder in folders:
        mine, num_left_out = curves.from_rows(folder.rows, x, y)
        if num_left_out:
            warn(f"{folder.path}: {num_left_out} evaluations left out, {y} is not a finite number there")
        absent = sorted({row["seed"] for row in folder.rows} - mine.keys())
        if absent or not folder.rows:
            numbers = f"seed {', '.join(map(str, absent))}" if absent else "the run"
            warn(f"{folder.path}: {numbers} not counted, there is no finite {y}")
        by_update, _ = curves.from_rows(folder.rows, "update", y)
        for number, curve in mine.items():
            seed = _Seed(folder.path, by_update[number], curve)
            same = next((i for i, other in enumerate(kept[number]) if once or seed.is_same(other)), None)
            if same is None:
                kept[number].append(seed)
                continue
            other = kept[number][same]
            warn(f"{folder.path}: seed {number} is that of {other.path}; the longer one is counted")
            kept[number][same] = max(other, seed, key=lambda one: one.by_update.x[-1])
    for number, several in kept.items():
        if len(several) > 1:
            names = ", ".join(str(seed.path) for seed in several)
            warn(f"seed {number} occurs {len(several)} times with different numbers, each is counted: {names}")
    return [seed.curve for several in kept.values() for seed in several]


class _Seed(NamedTuple):
    """A seed of a folder: over updates, for comparison, and over what is asked for."""

    path: Path
    by_update: Curve
    curve: Curve

    def is_same(self, other: "_Seed") -> bool:
        """Whether all that both evaluated agrees."""
        _, mine, others = np.intersect1d(self.by_update.x, other.by_update.x, return_indices=True)
        return mine.size > 0 and np.array_equal(self.by_update.y[mine], other.by_update.y[others])


def _run_folders(path: Path) -> Iterator[Path]:
    for folder, below, files in os.walk(path):
        if "config.yaml" in files and ("metrics.csv" in files or "manifest.json" in files):
            below.clear()
            yield Path(folder)
        below.sort()


def _differences(fields: Fields, all_fields: Sequence[Fields]) -> dict[str, str]:
    """What tells a config from others; the fields of a registered part only from those with the same part."""
    texts = {}
    for key in dict.fromkeys(key for other in all_fields for key in other):
        name = f"{key.partition('.')[0]}.name"
        peers = [other for other in all_fields if key == name or other.get(name) == fields.get(name)]
        values = [_text(other[key]) if key in other else "unset" for other in (fields, *peers)]
        if len(set(values)) > 1:
            texts[key] = values[0]
    return texts


def _network_presets(all_fields: Sequence[Fields]) -> list[str] | None:
    """Names of the network presets that the configs use, if they differ in more than one field and all use one."""
    keys = {key for fields in all_fields for key in fields if key.startswith("network.")}
    keys = {key for key in keys if any(other.get(key) != all_fields[0].get(key) for other in all_fields)}
    if len(keys) < 2:
        return None
    values = {choice: configs.preset("network", choice) for choice in configs.choices()["network"]}
    names = []
    for fields in all_fields:
        wanted: Mapping[str, Any] = {key.partition(".")[2]: fields.get(key) for key in keys}
        fitting = [choice for choice, preset in values.items() if wanted.items() <= preset.items()]
        names += fitting[-1:]  # small, not its other name simple
    return names if len(names) == len(all_fields) else None


def _short(key: str, keys: set[str]) -> str:
    """The field's name alone where only one part has it."""
    leaf = key.rpartition(".")[2]
    if leaf == "name":
        return key.partition(".")[0]
    return leaf if [other.rpartition(".")[2] for other in keys].count(leaf) == 1 else key


def _text(value: Any) -> str:
    """The value as one would type it."""
    if isinstance(value, float):
        return f"{value:g}"
    return json.dumps(value, separators=(",", ":")).strip('"')


def _by_number(text: str) -> list[str | float]:
    """A key that sorts numbers in a text by their size."""
    parts = re.split(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)", text)
    return [float(part) if number % 2 else part for number, part in enumerate(parts)]
