import json
import math

import jaxlib
import numpy as np
import pytest

from jaxswarm import config, reporting


def make_row(update, **metrics):
    start = {"update": update, "agent_steps": update * 10, "wall_seconds": update / 8, "seed": 3}
    return start | {"train/x": math.nan, "eval/return_std": 1.5, "eval/return": -100.0 / (update + 1)} | metrics


@pytest.fixture
def path(tmp_path):
    for update in (0, 5, 10):
        reporting.append_row(tmp_path / "metrics.csv", make_row(update))
    return tmp_path / "metrics.csv"


def test_rows_come_back_in_single_precision_with_the_leading_columns_first(path):
    assert (
        path.read_text().splitlines()[0] == "update,agent_steps,wall_seconds,seed,eval/return,eval/return_std,train/x"
    )
    rows = reporting.read_rows(path)
    assert [row["update"] for row in rows] == [0, 5, 10]
    assert np.float32(rows[1]["eval/return"]) == np.float32(-100 / 6)
    assert math.isnan(rows[0]["train/x"])
    assert path.read_text().splitlines()[1].endswith(",")


def test_a_torn_last_line_is_no_row(path):
    for torn in ("15,150", "15,150,1.0,3,-4.0,1.5,2.0", "15,1\n"):
        path.write_text(path.read_text() + torn)
        assert [row["update"] for row in reporting.read_rows(path)] == [0, 5, 10]
        assert len(reporting.keep_rows_before(path, 100)) == 3


def test_rows_from_an_update_on_are_removed_and_written_again_the_same(path):
    before = path.read_text()
    path.write_text(before + "15,15")
    assert [row["update"] for row in reporting.keep_rows_before(path, 10)] == [0, 5]
    reporting.append_row(path, make_row(10))
    assert path.read_text() == before


def test_removing_all_rows_removes_the_columns_too(path):
    assert reporting.keep_rows_before(path, 0) == []
    reporting.append_row(path, {"update": 0, "eval/return": 1.0})
    assert path.read_text() == "update,eval/return\n0,1.0\n"


def test_no_file_has_no_rows(tmp_path):
    assert reporting.read_rows(tmp_path / "none.csv") == []
    assert reporting.keep_rows_before(tmp_path / "none.csv", 5) == []


@pytest.mark.parametrize("num_rows", [0, 1, 30])
def test_a_curve_is_drawn_from_any_number_of_rows(tmp_path, num_rows):
    reporting.draw_curve(tmp_path / "curve.png", [make_row(10**5 * i) for i in range(num_rows)], "title")
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(tmp_path.iterdir())) == 1


def test_the_curve_of_several_seeds_shows_their_median(tmp_path):
    rows = [make_row(i, seed=seed) for i in range(3) for seed in (4, 5, 6)]
    reporting.draw_curve(tmp_path / "curve.svg", rows, "three")
    text = (tmp_path / "curve.svg").read_text()
    assert "median and quartiles of 3 seeds" in text
    assert text.count("stroke-width: 0.6;") == 3
    reporting.draw_curve(tmp_path / "curve.svg", rows[::3], "one")
    assert "mean ± std" in (tmp_path / "curve.svg").read_text()


def test_the_manifest_has_versions_device_and_the_arithmetic_of_steps(tmp_path):
    experiment = config.build(config.compose(["experiment=rendezvous_thesis"]))
    path = tmp_path / "manifest.json"
    reporting.write_manifest(path, reporting.manifest(experiment, 160, [4]))
    manifest = json.loads(path.read_text())
    assert manifest["seeds"] == [4]
    assert manifest["versions"]["jaxlib"] == jaxlib.__version__
    assert manifest["device"]["backend"]
    steps = manifest["steps"]
    assert (steps["agent_steps_per_update"], steps["agent_steps"]) == (164_000, 26_240_000)
    assert (steps["environment_steps"], steps["evaluations"]) == (1_312_000, 161)
    assert (steps["gradient_steps_per_update"], steps["gradient_steps"]) == (1640, 262_400)


def test_the_manifest_of_a_resumed_run_keeps_the_earlier_ones(tmp_path):
    for i in range(3):
        reporting.write_manifest(tmp_path / "m.json", {"session": i})
    manifest = json.loads((tmp_path / "m.json").read_text())
    assert manifest == {"session": 2, "earlier_sessions": [{"session": 0}, {"session": 1}]}


def test_without_a_terminal_progress_is_a_line_now_and_then(capsys):
    with reporting.Progress(0, 1000, 500) as progress:
        progress.begin()
        for update in range(1, 1001):
            progress.advance(update, -12.345 if update > 1 else None)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["compiling ...", "compiled in 0 s; training ..."]
    assert lines[2].startswith("update 1/1000 · return -")
    assert lines[-1].startswith("update 1000/1000 · return -12.3")
    assert "agent steps/s · 0:00 left" in lines[-1]
    assert len(lines) == 4


def test_silent_progress_says_nothing(capsys):
    with reporting.Progress(0, 2, 500, is_shown=False) as progress:
        progress.begin()
        progress.advance(2, 1.0)
    assert capsys.readouterr().out == ""


def test_notebooks_without_widgets_get_lines(capsys, monkeypatch):
    """There, rich would warn and draw a bar that does not move."""
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with reporting.Progress(0, 2, 500) as progress:
        progress.advance(2, 1.0)
    assert capsys.readouterr().out.splitlines()[-1].startswith("update 2/2 · return 1.0")
