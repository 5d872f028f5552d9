"""A damaged or edited run folder resumes to the same numbers with a warning, or is refused with one line."""

import json
import re
import shutil

import jax
import numpy as np
import pytest
import yaml

from jaxswarm import config as configs
from jaxswarm.config import ConfigError
from jaxswarm.host import checkpoint
from jaxswarm.host.checkpoint import CheckpointError
from jaxswarm.host.ensemble import abstract_state
from jaxswarm.host.fit import fit_runs
from jaxswarm.host.resume import resume_points
from jaxswarm.host.run import Run, check_folder, load_config

OVERRIDES = (
    "task.num_agents=3 task.episode_length=5 num_envs=2 num_steps=4 learner.batch_size=12 num_eval_envs=2 eval_every=2 "
    "network.encoder=[4] network.decoder=[4] num_updates=8 checkpoint_seconds=0"
)
OTHER_TYPES = [None, True, -1, 1e99, "text", [], {}, [{"a": [None]}]]
DAMAGES = ("deleted", "emptied", "halved", "flipped", "foreign", "marked")
METRICS = ["metrics.csv", "checkpoints/metrics.csv"]


def train(run_dir, *changes):
    fit_runs([Run.from_config(configs.compose([*OVERRIDES.split(), *changes]), run_dir)], progress=False)
    return run_dir


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return train(tmp_path_factory.mktemp("faults") / "run")


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    return train(tmp_path_factory.mktemp("faults") / "foreign", "seed=7", "learner.learning_rate=0.01")


@pytest.fixture
def run_dir(original, tmp_path):
    return shutil.copytree(original, tmp_path / "run")


def updates(run_dir):
    return sorted(int(path.name) for path in (run_dir / "checkpoints").iterdir() if path.name.isdecimal())


def leaves(state):
    return [
        np.asarray(jax.random.key_data(x)) if jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key) else np.asarray(x)
        for x in jax.tree.leaves(state)
    ]


def resume(run_dir, force=False):
    """Return the verified point that the program would resume from."""
    run = Run.from_config(load_config(run_dir) | {"num_updates": 12}, run_dir)
    check_folder(run, resume=True, force=force)
    (point,) = resume_points([run], force)
    return point


def assert_same_or_refused(run_dir, original, capsys):
    """Return whether the folder resumes, at a point of the original run and with at least one line of warning."""
    try:
        point = resume(run_dir)
    except (ConfigError, CheckpointError, FileExistsError) as error:
        assert len(str(error).splitlines()) == 1  # noqa: PT017
        return False
    update = point.restored.update
    template = abstract_state(configs.build(configs.load(original / "config.yaml")), 1)
    expected = checkpoint.restore(original / "checkpoints", template, up_to=update)
    assert expected.update == update
    for a, b in zip(leaves(point.restored.train_state), leaves(expected.train_state), strict=True):
        np.testing.assert_array_equal(a, b)
    lines = (original / "metrics.csv").read_text().splitlines()
    assert point.lines == lines[: len(point.lines)]
    assert len(point.lines) == 1 + len([line for line in lines[1:] if int(line.split(",")[0]) < update])
    assert capsys.readouterr().err.startswith("warning: ")
    return True


def damage(path, kind, foreign):
    content = path.read_bytes()
    if kind == "deleted":
        path.unlink()
    elif kind == "emptied":
        path.write_bytes(b"")
    elif kind == "halved":
        path.write_bytes(content[: len(content) // 2])
    elif kind == "flipped":
        middle = len(content) // 2
        path.write_bytes(content[:middle] + bytes([content[middle] ^ 16]) + content[middle + 1 :])
    elif kind == "foreign":
        shutil.copyfile(foreign, path)
    else:
        path.write_bytes(b"\xff\xfe" + content)


def files_of(run_dir):
    """Return the names of the files whose damage must be found: configs, rows, and the newest and best checkpoint."""
    newest, best = (
        updates(run_dir)[-1],
        max(updates(run_dir), key=lambda n: checkpoint._read_score(run_dir / "checkpoints", n)),
    )
    of_checkpoints = [
        file.relative_to(run_dir).as_posix()
        for update in {newest, best}
        for file in (run_dir / "checkpoints" / str(update)).rglob("*")
        if file.is_file()
    ]
    return ["config.yaml", "manifest.json", *METRICS, *sorted(of_checkpoints)]


@pytest.mark.slow
@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_file_is_noticed(kind, original, foreign, tmp_path, capsys):
    for index, name in enumerate(files_of(original)):
        run_dir = shutil.copytree(original, tmp_path / str(index))
        source = foreign / re.sub(r"/\d+/", f"/{updates(foreign)[-1]}/", name)
        if kind == "foreign" and (not source.exists() or source.read_bytes() == (run_dir / name).read_bytes()):
            continue
        damage(run_dir / name, kind, source)
        capsys.readouterr()
        can_differ = name == "config.yaml" and kind in ("halved", "flipped", "foreign")
        # The copy is not read while the original is intact, and most of the manifest is for readers only.
        unneeded = name == METRICS[1] or (name, kind) == ("manifest.json", "flipped")
        if unneeded:
            assert resume(run_dir)
        else:
            assert assert_same_or_refused(run_dir, original, capsys) or can_differ, (name, kind)


@pytest.mark.parametrize(
    "edit",
    [
        lambda lines: lines[:1],
        lambda lines: lines[1:],
        lambda lines: lines[:2] + lines[3:],
        lambda lines: [*lines[:2], lines[1], *lines[2:]],
        lambda lines: [lines[0], lines[2], lines[1], *lines[3:]],
        lambda lines: [lines[0], lines[1].replace("-", ""), *lines[2:]],
        lambda lines: [lines[0], lines[1].replace("0", "text"), *lines[2:]],
    ],
)
def test_edited_rows_are_restored(edit, run_dir, original, capsys):
    path = run_dir / "metrics.csv"
    path.write_text("".join(f"{line}\n" for line in edit(path.read_text().splitlines())))
    assert assert_same_or_refused(run_dir, original, capsys)


def test_rows_that_are_lost_twice_are_refused(run_dir):
    for name in METRICS:
        (run_dir / name).write_text("")
    with pytest.raises(ConfigError, match=r"metrics\.csv and its copy .*force=true"):
        resume(run_dir)
    assert resume(run_dir, force=True).lines == []


@pytest.mark.parametrize(
    ("key", "value"),
    [("learner.learning_rate", 0.01), ("learner.discount", 0.5), ("num_steps", 8), ("eval_every", 3)],
)
def test_an_edited_setting_is_refused_with_the_difference(key, value, run_dir, capsys):
    config = configs.override(configs.load(run_dir / "config.yaml"), [(key, value)])
    (run_dir / "config.yaml").write_text(configs.dump(config))
    with pytest.raises(ConfigError, match=rf"{key}: \S+ in the checkpoint, {value} in .*init_from=.*force=true"):
        resume(run_dir)
    if key.startswith("learner."):
        resume(run_dir, force=True)
        assert f"{key}: " in capsys.readouterr().err


def test_another_seed_is_refused(run_dir):
    config = configs.override(configs.load(run_dir / "config.yaml"), [("seed", 4)])
    (run_dir / "config.yaml").write_text(configs.dump(config))
    with pytest.raises(ConfigError, match="seed: 0 in the checkpoint, 4 in"):
        resume(run_dir)


def test_another_aggregator_is_refused(run_dir):
    text = (run_dir / "config.yaml").read_text()
    (run_dir / "config.yaml").write_text(text.replace("name: mean", "name: max"))
    with pytest.raises(ConfigError, match=r"aggregator.name: mean in the checkpoint, max in"):
        resume(run_dir)


def test_a_checkpoint_of_another_run_is_set_aside(run_dir, original, foreign, capsys):
    shutil.copytree(foreign / "checkpoints" / "8", run_dir / "checkpoints" / "10")
    assert assert_same_or_refused(run_dir, original, capsys)
    assert 10 not in updates(run_dir)


def test_missing_digests_are_damage(run_dir, original, capsys):
    (run_dir / "checkpoints" / "8" / "digests.json").unlink()
    assert assert_same_or_refused(run_dir, original, capsys)


def test_a_newer_version_is_reported(run_dir, monkeypatch, capsys):
    monkeypatch.setattr("jaxswarm.host.identity._version", lambda _: "99.0")
    assert any(change.startswith("jaxswarm ") for change in resume(run_dir).changes)
    assert re.search(r"jax \S+ before, 99.0 now.*may differ in their last bits", capsys.readouterr().err)


def paths_of(tree, path=()):
    """Yield the path of every value of a JSON or YAML file."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from paths_of(value, (*path, key))


def replaced(tree, path, value):
    tree = json.loads(json.dumps(tree))
    inner = tree
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return tree


@pytest.mark.parametrize("name", ["manifest.json", "config.yaml"])
def test_fields_of_another_type_end_in_no_traceback(name, original, run_dir, tries):
    content = yaml.safe_load((original / name).read_text())
    random = np.random.default_rng(0)
    cases = [(path, value) for path in paths_of(content) for value in OTHER_TYPES]
    for index in random.choice(len(cases), min(tries, len(cases)), replace=False):
        shutil.rmtree(run_dir)
        shutil.copytree(original, run_dir)
        text = json.dumps(replaced(content, *cases[index]))
        (run_dir / name).write_text(text)
        try:
            resume(run_dir)
        except (ConfigError, CheckpointError, FileExistsError) as error:
            assert len(str(error).splitlines()) == 1  # noqa: PT017


@pytest.mark.parametrize("content", ["null", "3", "[]", '{"a": ' * 2000 + "1" + "}" * 2000, "[" * 100_000])
@pytest.mark.parametrize("name", ["manifest.json", "config.yaml"])
def test_files_of_another_form_are_restored(name, content, run_dir, original, capsys):
    (run_dir / name).write_text(content)
    assert assert_same_or_refused(run_dir, original, capsys)


def test_leftovers_of_a_kill_are_removed(run_dir, original):
    (run_dir / ".config.yaml.1.tmp").write_text("half")
    (run_dir / "checkpoints" / ".9.tmp").mkdir()
    fit_runs([Run.from_config(load_config(run_dir) | {"num_updates": 9}, run_dir)], resume=True, progress=False)
    assert not [path for path in run_dir.rglob(".*") if path.name.endswith(".tmp")]
