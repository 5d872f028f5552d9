import dataclasses
import math

import numpy as np
import pytest
import yaml

from jaxswarm import config as configs
from jaxswarm import files
from jaxswarm.analysis import run_folders as runs
from jaxswarm.config import ConfigError


@pytest.fixture(scope="module")
def default():
    return configs.compose()


@pytest.fixture
def write(tmp_path, default):
    """Return a function that writes a run folder from changes of the default config and the returns of each seed."""

    def write(name, returns, changes=(), eval_every=5):
        folder = tmp_path / name
        folder.mkdir(parents=True)
        config = configs.override(default, [("eval_every", eval_every), *changes])
        (folder / "config.yaml").write_text(configs.dump(config))
        rows = []
        for update in range(max(map(len, returns.values()), default=0)):
            for seed, values in returns.items():
                if update < len(values):
                    row = {"update": update * eval_every, "agent_steps": update * eval_every * 100}
                    row |= {"wall_seconds": update / 8, "seed": seed, "eval/return": values[update]}
                    rows.append(row)
        if rows:
            files.write_rows(folder / "metrics.csv", rows)
        return folder

    return write


def group(folder):
    return runs.group([runs.read(path) for path in runs.find([folder])])


def test_folders_are_searched_and_each_is_found_once(write, tmp_path):
    first, second = write("a/b/first", {0: [1.0]}), write("second", {0: [1.0]})
    (first / "checkpoints" / "0").mkdir(parents=True)
    (first / "checkpoints" / "config.yaml").touch()
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "config.yaml").write_text("no: run\n")
    assert runs.find([tmp_path, first, tmp_path / "a" / ".." / "second"]) == [first, tmp_path / "a" / ".." / "second"]
    assert second.exists()


@pytest.mark.parametrize("name", ["", "nowhere"])
def test_a_path_without_runs_is_an_error(tmp_path, name):
    with pytest.raises(ConfigError, match="run folder"):
        runs.find([tmp_path / name])


def test_seeds_lengths_checkpoints_and_times_of_evaluation_make_no_group(write, tmp_path):
    write("a", {0: [1.0], 1: [2.0]})
    write("b", {2: [3.0]}, [("seed", 2), ("num_updates", 7), ("keep_checkpoints", 1)], eval_every=3)
    ((label, members),) = group(tmp_path).items()
    assert label == "rendezvous, mean, ppo"
    assert len(members) == 2


def test_groups_are_named_by_what_differs_in_order_of_the_numbers(write, tmp_path):
    for rate in (0.001, 3e-4):
        for num_agents in (10, 5):
            changes = [("learner.learning_rate", rate), ("task.num_agents", num_agents)]
            write(f"{rate}-{num_agents}", {0: [1.0]}, changes)
    agents = [f"num_agents={n}, learning_rate={rate}" for n in (5, 10) for rate in ("0.0003", "0.001")]
    assert list(group(tmp_path)) == agents


def test_another_part_is_named_without_its_fields_unless_they_differ(default):
    aggregators = [{"name": "mean"}, {"name": "bayesian", "rectifier": "exp"}, {"name": "bayesian", "rectifier": "x"}]
    flat = [{f"aggregator.{key}": x for key, x in fields.items()} for fields in aggregators]
    assert runs.label(flat[:2]) == ["aggregator=mean", "aggregator=bayesian"]
    assert runs.label(flat) == ["aggregator=mean", *(f"aggregator=bayesian, rectifier={x}" for x in ("exp", "x"))]


def test_networks_that_are_presets_are_named_so(write, tmp_path):
    for name in ("small", "medium", "mean_opt"):
        write(name, {0: [1.0]}, [(f"network.{key}", x) for key, x in configs.preset("network", name).items()])
    assert list(group(tmp_path)) == ["network=mean_opt", "network=medium", "network=small"]


def test_other_networks_are_named_by_their_fields(write, tmp_path):
    write("a", {0: [1.0]})
    write("b", {0: [1.0]}, [("network.encoder", [8, 4]), ("network.decoder", [2])])
    assert list(group(tmp_path)) == ["encoder=[8,4], decoder=[2]", "encoder=[64], decoder=[64]"]


def test_fields_of_the_same_name_keep_their_part():
    flat = [{"task.num_bins": 1, "aggregator.num_bins": 1}, {"task.num_bins": 2, "aggregator.num_bins": 2}]
    assert runs.label(flat)[1] == "task.num_bins=2, aggregator.num_bins=2"


def test_a_config_of_an_older_version_has_the_defaults_of_keys_it_lacks(write, tmp_path):
    write("new", {0: [1.0]})
    old = write("old", {1: [1.0]}) / "config.yaml"
    config = yaml.safe_load(old.read_text())
    del config["network"]["std"]
    old.write_text(yaml.safe_dump(config))
    assert len(group(tmp_path)) == 1
    config["task"]["given_up"] = 1
    old.write_text(yaml.safe_dump(config))
    assert list(group(tmp_path)) == ["std=shared, given_up=unset", "std=unset, given_up=1"]


def test_each_seed_of_a_group_is_a_curve(write, tmp_path):
    write("a", {0: [1.0, 2.0], 1: [3.0, 4.0]})
    write("b", {2: [5.0, 6.0, 7.0]})
    (members,) = group(tmp_path).values()
    found = runs.seeds(members, "agent_steps", "eval/return", pytest.fail)
    assert [curve.y.tolist() for curve in found] == [[1, 2], [3, 4], [5, 6, 7]]
    assert found[2].x.tolist() == [0, 500, 1000]


def test_copies_and_continued_runs_count_once(write, tmp_path):
    for name, returns in (("a", [1.0, 2.0]), ("b", [1.0, 2.0, 3.0]), ("c", [1.0])):
        write(name, {0: returns})
    (members,) = group(tmp_path).values()
    warnings = []
    (curve,) = runs.seeds(members, "agent_steps", "eval/return", warnings.append)
    assert curve.y.tolist() == [1, 2, 3]
    names = [(tmp_path / name, tmp_path / other) for name, other in (("b", "a"), ("c", "b"))]
    expected = [f"{name}: seed 0 is also in {other}; only the longer one is counted" for name, other in names]
    assert warnings == expected


def test_what_is_not_counted_is_told(write, tmp_path):
    write("a", {0: [1.0, math.nan], 1: [math.nan]})
    write("b", {0: [1.0, 5.0, 6.0], 2: [0.0]})
    write("c", {0: [1.5]})
    (members,) = group(tmp_path).values()
    members.append(dataclasses.replace(members[0], rows=[], path=tmp_path / "empty"))
    warnings = []
    found = runs.seeds(members, "update", "eval/return", warnings.append)
    assert [curve.y.tolist() for curve in found] == [[1, 5, 6], [1.5], [0]]
    texts = ["eval/return is not finite: 2", "left out seed 1", "seed 0 is also in", "empty: left out the run"]
    texts += [f"seed 0 occurs 2 times with different values; each one is counted: {tmp_path / 'b'}, {tmp_path / 'c'}"]
    assert all(text in line for text, line in zip(texts, warnings, strict=True)), warnings


@pytest.mark.parametrize(
    ("table", "part"), [("update,seed\n1,x\n", "invalid literal"), ("update,seed\n1,2\n", "no column agent_steps")]
)
def test_a_table_that_is_none_is_an_error(write, table, part):
    folder = write("a", {0: [1.0]})
    (folder / "metrics.csv").write_text(table)
    with pytest.raises(ConfigError, match=rf"cannot read .*metrics.csv: .*{part}"):
        runs.read(folder)


def test_numbers_of_single_precision_are_read(write):
    rows = runs.read(write("a", {0: [0.1]})).rows
    assert np.float32(rows[0]["eval/return"]) == np.float32(0.1)
