"""Disks that are full or read-only, and files that are deleted during training, cost no finished update."""

import errno
import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from jaxswarm import config as configs
from jaxswarm import files
from jaxswarm.files import is_vacant
from jaxswarm.host import checkpoint
from jaxswarm.host.fit import fit_runs
from jaxswarm.host.run import Run

# Orbax leaves futures of a checkpoint behind that cannot be written to its end.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
OVERRIDES = (
    "task.num_agents=3 task.episode_length=5 num_envs=2 num_steps=4 learner.batch_size=12 num_eval_envs=2 eval_every=2 "
    "network.encoder=[4] network.decoder=[4] num_updates=8 checkpoint_seconds=0"
)
CONFIG = configs.compose(OVERRIDES.split())


@pytest.fixture(autouse=True)
def without_waiting(monkeypatch):
    monkeypatch.setattr(files, "SECONDS_FOR_SPACE", 0.0)


def train(run_dir, resume=False, on_evaluation=None):
    run = Run(configs.build(CONFIG), configs.run_settings(CONFIG), run_dir, CONFIG, on_evaluation)
    fit_runs([run], resume=resume, progress=False)
    return run_dir


def table(run_dir):
    return [{k: x for k, x in row.items() if k != "wall_seconds"} for row in files.read_rows(run_dir / "metrics.csv")]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return train(tmp_path_factory.mktemp("disks") / "run")


def assert_recovers(run_dir, undisturbed):
    """Resume, or start again where nothing was written, and compare with the undisturbed run."""
    train(run_dir, resume=not is_vacant(run_dir))
    np.testing.assert_equal(table(run_dir), table(undisturbed))
    assert not [path for path in run_dir.rglob(".*") if path.name.endswith(".tmp")]


class Disk:
    """A disk on which the writes from the n-th on fail."""

    def __init__(self, monkeypatch, number, code):
        self.writes, self.number, self.code = 0, number, code
        for owner, name in ((files, "append_text"), (files, "replace_bytes"), (checkpoint, "_orbax")):
            monkeypatch.setattr(owner, name, self.failing(getattr(owner, name)))

    def failing(self, write):
        def wrapped(*args):
            self.writes += 1
            if self.writes > self.number:
                raise OSError(self.code, os.strerror(self.code))
            return write(*args)

        return wrapped


@pytest.mark.parametrize("number", [0, 1, 2, 3, 4, 5, 7, 9, 12, 16, 20])
def test_writes_that_fail_end_training_with_one_line(number, undisturbed, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        disk = Disk(patch, number, errno.ENOSPC)
        with pytest.raises(OSError, match=r"no space left on device; the last \d+ updates were not saved") as error:
            train(tmp_path / "run")
    assert disk.writes > number
    assert len(str(error.value).splitlines()) == 1
    assert_recovers(tmp_path / "run", undisturbed)


@pytest.mark.parametrize("code", [errno.EDQUOT, errno.EROFS, errno.EIO, errno.EACCES])
def test_other_errors_are_named(code, undisturbed, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        Disk(patch, 9, code)
        with pytest.raises(OSError, match=re.escape(os.strerror(code).lower())):
            train(tmp_path / "run")
    assert_recovers(tmp_path / "run", undisturbed)


def test_a_full_disk_while_resuming(undisturbed, tmp_path, monkeypatch):
    stop_after(tmp_path / "run", 2, monkeypatch)
    with monkeypatch.context() as patch:
        Disk(patch, 3, errno.ENOSPC)
        with pytest.raises(OSError, match="no space left"):
            train(tmp_path / "run", resume=True)
    assert_recovers(tmp_path / "run", undisturbed)


def stop_after(run_dir, update, monkeypatch):
    """Train until a failure behind this update, which leaves checkpoints."""

    def fail(at, _):
        if at >= update:
            raise OSError(errno.EIO, "stopped")

    with pytest.raises(OSError, match="stopped"):
        train(run_dir, on_evaluation=fail)


def remove(folder):
    while folder.exists():  # a checkpoint is being written there
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["metrics.csv", "config.yaml", "checkpoints/metrics.csv", "checkpoints"])
def test_deleted_files_are_restored(name, undisturbed, tmp_path, capsys):
    run_dir = tmp_path / "run"

    def delete(update, _):
        if update == 4:
            path = run_dir / name
            remove(path) if path.is_dir() else path.unlink()

    train(run_dir, on_evaluation=delete)
    np.testing.assert_equal(table(run_dir), table(undisturbed))
    assert (run_dir / "config.yaml").exists()
    assert "deleted during training" in capsys.readouterr().err


@pytest.mark.slow
def test_a_deleted_run_folder_ends_training(tmp_path):
    run_dir = tmp_path / "run"
    with pytest.raises(OSError, match="was deleted or moved during training"):
        train(run_dir, on_evaluation=lambda update, _: update == 4 and remove(run_dir))


@pytest.fixture
def mounted(tmp_path):
    """Return a function that mounts a small file system with these options, or changes them."""
    folder = tmp_path / "small"
    folder.mkdir()

    def mount(options):
        word = "remount," if os.path.ismount(folder) else ""
        command = ["mount", "-t", "tmpfs", "-o", f"{word}{options}", "tmpfs", str(folder)]
        if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("only root can mount a file system")
        return folder

    yield mount
    subprocess.run(["umount", str(folder)], capture_output=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("options", ["size=4k", "size=40k", "size=300k", "size=450k", "nr_inodes=5", "nr_inodes=90"])
def test_small_disks(options, undisturbed, mounted):
    folder = mounted(options)
    with pytest.raises(OSError, match="no space left"):
        train(folder / "run")
    mounted("size=50m,nr_inodes=10000")
    assert_recovers(folder / "run", undisturbed)


@pytest.mark.slow
def test_a_disk_that_becomes_read_only(undisturbed, mounted):
    folder = mounted("size=50m")
    with pytest.raises(OSError, match="read-only file system"):
        train(folder / "run", on_evaluation=lambda update, _: update == 4 and mounted("ro"))
    mounted("rw")
    assert_recovers(folder / "run", undisturbed)
