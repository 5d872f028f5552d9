"""Rows of metrics.csv survive truncated lines, removed rows and missing files."""

import errno
import math
import os

import numpy as np
import pytest

from jaxswarm import files
from jaxswarm.host.metrics_log import MetricsLog


def make_row(update, **metrics):
    start = {"update": update, "agent_steps": update * 10, "wall_seconds": update / 8, "seed": 3}
    return start | {"train/x": math.nan, "eval/return_std": 1.5, "eval/return": -100.0 / (update + 1)} | metrics


@pytest.fixture
def path(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    MetricsLog(tmp_path, []).append([make_row(update) for update in (0, 5, 10)])
    return tmp_path / "metrics.csv"


def test_rows_come_back_in_single_precision_with_the_leading_columns_first(path):
    header = path.read_text().splitlines()[0]
    assert header == "update,agent_steps,wall_seconds,seed,eval/return,eval/return_std,train/x"
    rows = files.read_rows(path)
    assert [row["update"] for row in rows] == [0, 5, 10]
    assert np.float32(rows[1]["eval/return"]) == np.float32(-100 / 6)
    assert math.isnan(rows[0]["train/x"])
    assert path.read_text().splitlines()[1].endswith(",")


def test_a_torn_last_line_is_no_row(path):
    for torn in ("15,150", "15,150,1.0,3,-4.0,1.5,2.0", "15,1\n"):
        path.write_text(path.read_text() + torn)
        assert [row["update"] for row in files.read_rows(path)] == [0, 5, 10]


def test_rows_that_are_read_are_written_again_the_same(path):
    before = path.read_text()
    files.write_rows(path, files.read_rows(path))
    assert path.read_text() == before
    files.write_rows(path, [])
    assert path.read_text() == ""


def test_text_that_cannot_be_appended_leaves_the_file_as_it_was(path, monkeypatch):
    before = path.read_text()
    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space"):
        files.append_text(path, "15,150\n")
    assert path.read_text() == before


def test_writing_waits_for_space(path, monkeypatch, capsys):
    attempts = []

    def write():
        attempts.append(1)
        if len(attempts) < 3:
            full_disk()

    monkeypatch.setattr(files.time, "sleep", lambda _: None)
    files.wait_for_space(write, path.parent)
    assert len(attempts) == 3
    assert capsys.readouterr().err.count("waiting for space") == 1
    monkeypatch.setattr(files, "SECONDS_FOR_SPACE", 0)
    with pytest.raises(OSError, match="No space"):
        files.wait_for_space(full_disk, path.parent)


def full_disk(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_no_file_has_no_rows(tmp_path):
    assert files.read_rows(tmp_path / "none.csv") == []


def test_a_byte_order_mark_is_skipped(path):
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert [row["update"] for row in files.read_rows(path)] == [0, 5, 10]


def test_folders_of_one_name_are_claimed_once(tmp_path):
    claimed = [files.claim_folder(tmp_path / "runs" / "a") for _ in range(3)]
    assert [folder.name for folder in claimed] == ["a", "a-2", "a-3"]


def test_temporary_files_of_an_interrupted_write_do_not_fill_a_folder(tmp_path):
    assert files.is_vacant(tmp_path / "missing")
    (tmp_path / ".config.yaml.123.tmp").write_text("half")
    assert files.is_vacant(tmp_path)
    (tmp_path / "config.yaml").write_text("")
    assert not files.is_vacant(tmp_path)
    files.remove_temporary_files(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["config.yaml"]
    assert not files.is_vacant(tmp_path / "config.yaml")


def test_a_folder_without_results_is_removed(tmp_path):
    for name, content in (("empty", None), ("full", "x")):
        with files.removed_if_empty(tmp_path / name):
            (tmp_path / name).mkdir()
            if content:
                (tmp_path / name / "file").write_text(content)
    assert [folder.name for folder in tmp_path.iterdir()] == ["full"]


@pytest.mark.parametrize(("size", "text"), [(0, "0 bytes"), (999, "999 bytes"), (12_345, "12 kB"), (999_600, "1.0 MB")])
def test_sizes_of_files_have_a_unit_that_fits(tmp_path, size, text):
    (tmp_path / "file").write_bytes(bytes(size))
    assert files.size_text(tmp_path / "file") == text
