import shutil
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxswarm.host import checkpoint
from jaxswarm.host.checkpoint import CheckpointError, Checkpoints
from jaxswarm.types import pytree


@pytree
class State:
    key: jax.Array
    count: jax.Array
    nested: dict


def make_state(seed=0):
    noise = np.random.default_rng(seed).normal(size=(3, 4)).astype(np.float32)
    nested = {"a.b": jnp.asarray(noise), "flag": jnp.asarray([True, False]), "none": jnp.zeros((0, 2))}
    return State(jax.random.key(seed), jnp.int32(seed), nested)


TEMPLATE = jax.eval_shape(make_state)


def write(directory, scores, keep=2):
    checkpoints = Checkpoints(directory, keep)
    for update, score in scores.items():
        checkpoints.save(update, make_state(update), {"wall_seconds": update / 3}, score)
    checkpoints.close()


def updates(directory):
    return sorted(int(path.name) for path in directory.iterdir() if path.name.isdigit())


def damage(directory, update):
    file = max((directory / str(update) / "state").rglob("d/*"), key=lambda path: path.stat().st_size)
    file.write_bytes(file.read_bytes()[:-7])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    directory = tmp_path_factory.mktemp("checkpoints")
    write(directory, {1: -5.0, 2: -1.0, 3: -4.0, 4: None, 5: -3.0})
    return directory


@pytest.fixture
def copy(written, tmp_path):
    return shutil.copytree(written, tmp_path / "copy")


def test_a_state_comes_back_bit_by_bit_with_its_keys(written):
    restored = checkpoint.restore(written, TEMPLATE)
    assert (restored.update, restored.record, restored.score) == (5, {"wall_seconds": 5 / 3}, -3.0)
    expected = make_state(5)
    assert jax.tree.structure(restored.train_state) == jax.tree.structure(expected)
    for found, wanted in zip(jax.tree.leaves(restored.train_state), jax.tree.leaves(expected), strict=True):
        assert (found.dtype, found.shape) == (wanted.dtype, wanted.shape)
    key_data = [jax.random.key_data(state.key) for state in (restored.train_state, expected)]
    np.testing.assert_array_equal(*key_data)
    np.testing.assert_array_equal(restored.train_state.nested["a.b"], expected.nested["a.b"])


def test_the_latest_and_the_best_are_kept(written):
    assert updates(written) == [2, 4, 5]
    assert checkpoint.restore(written, TEMPLATE, "best").update == 2


def test_the_best_stays_the_best_when_a_run_is_resumed(copy):
    write(copy, {6: -2.0, 7: None})
    assert updates(copy) == [2, 6, 7]


def test_a_score_can_be_added_later(copy):
    write(copy, {6: None})
    write(copy, {6: -0.5})
    assert checkpoint.restore(copy, TEMPLATE, "best").update == 6


def test_a_damaged_checkpoint_gives_way_to_the_one_before_and_is_reported(copy):
    said = []
    damage(copy, 5)
    assert checkpoint.restore(copy, TEMPLATE, on_damage=said.append).update == 4
    assert len(said) == 1
    assert "5 is damaged" in said[0]
    checkpoint.set_aside(copy, lambda update: update <= 4)
    write(copy, {5: -3.0})
    assert checkpoint.restore(copy, TEMPLATE).update == 5
    assert list(copy.glob("damaged-5-*"))


def test_a_missing_file_is_damage(copy):
    (copy / "5" / "state" / "manifest.ocdbt").unlink()
    assert checkpoint.restore(copy, TEMPLATE, on_damage=lambda _: None).update == 4


def test_without_any_whole_checkpoint_there_is_an_error(copy):
    for update in updates(copy):
        damage(copy, update)
    with pytest.raises(CheckpointError, match=r"none of the checkpoints.*\[2, 4, 5\]"):
        checkpoint.restore(copy, TEMPLATE, on_damage=lambda _: None)


def test_a_state_of_another_shape_is_named_and_not_called_damaged(written):
    said = []
    template = TEMPLATE.replace(nested=TEMPLATE.nested | {"a.b": jax.ShapeDtypeStruct((3, 5), jnp.float32)})
    with pytest.raises(CheckpointError, match=r"nested\.a\.b is float32\[3, 4\], but .* float32\[3, 5\]"):
        checkpoint.restore(written, template, on_damage=said.append)
    assert not said


def test_where_nothing_was_written_there_is_nothing_to_restore(tmp_path):
    assert checkpoint.restore(tmp_path / "none", TEMPLATE) is None


def test_where_nothing_is_written_no_thread_outlives_it(tmp_path):
    before = set(threading.enumerate())
    Checkpoints(tmp_path / "new").close()
    assert set(threading.enumerate()) <= before


def test_text_is_replaced_as_a_whole(tmp_path):
    checkpoint.replace_text(tmp_path / "a", "first")
    checkpoint.replace_text(tmp_path / "a", "second")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a", "second")]
