"""The learning curve `curve.png` shows runs of one seed and of several seeds."""

import math

import pytest

from jaxswarm.analysis import training_curve


def make_row(update, **metrics):
    start = {"update": update, "agent_steps": update * 10, "wall_seconds": update / 8, "seed": 3}
    return start | {"train/x": math.nan, "eval/return_std": 1.5, "eval/return": -100.0 / (update + 1)} | metrics


@pytest.mark.parametrize("num_rows", [0, 1, 30])
def test_a_curve_is_drawn_from_any_number_of_rows(tmp_path, num_rows):
    training_curve.draw_curve(tmp_path / "curve.png", [make_row(10**5 * i) for i in range(num_rows)], "title")
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(tmp_path.iterdir())) == 1


def test_the_curve_of_several_seeds_shows_their_median(tmp_path):
    rows = [make_row(i, seed=seed) for i in range(3) for seed in (4, 5, 6)]
    training_curve.draw_curve(tmp_path / "curve.svg", rows, "three")
    text = (tmp_path / "curve.svg").read_text()
    assert "median and quartiles of 3 seeds" in text
    assert text.count("stroke-width: 0.6;") == 3
    training_curve.draw_curve(tmp_path / "curve.svg", rows[::3], "one")
    assert "mean ± std" in (tmp_path / "curve.svg").read_text()


def test_the_users_settings_of_matplotlib_have_no_influence(tmp_path, monkeypatch):
    import matplotlib as mpl  # noqa: PLC0415

    rows = [make_row(i) for i in range(3)]
    training_curve.draw_curve(tmp_path / "ours.svg", rows, "title")
    monkeypatch.setitem(mpl.rcParams, "lines.linewidth", 9.0)
    monkeypatch.setitem(mpl.rcParams, "text.usetex", True)
    training_curve.draw_curve(tmp_path / "theirs.svg", rows, "title")
    assert (tmp_path / "ours.svg").read_bytes() == (tmp_path / "theirs.svg").read_bytes()
    assert mpl.rcParams["lines.linewidth"] == 9.0
