"""Summaries over seeds agree with SciPy, and are written as text, CSV and LaTeX."""

import csv
import math

import numpy as np
import pytest
from scipy import stats

from jaxswarm.analysis import curves, summaries
from jaxswarm.analysis.curves import Curve

OURS, OTHERS = np.random.default_rng(3).normal(np.array([[0.5], [0.0]]), size=(2, 10))


def test_the_statistics_of_a_summary_are_those_of_scipy():
    line = summaries.summarize(OURS)
    assert [line[x] for x in ("q25", "median", "q75")] == pytest.approx(np.percentile(OURS, [25, 50, 75]))
    assert line["iqm"] == pytest.approx(stats.trim_mean(OURS, 0.25))
    interval = stats.bootstrap(
        (OURS,), lambda x, axis: stats.trim_mean(x, 0.25, axis=axis), n_resamples=9999, method="percentile", rng=1
    ).confidence_interval
    assert (line["iqm_low"], line["iqm_high"]) == pytest.approx(tuple(interval), abs=0.1)


def test_one_seed_has_no_intervals_and_no_seed_has_no_values():
    line = summaries.summarize(np.array([2.0]))
    assert (line["median"], line["iqm"]) == (2, 2)
    assert all(math.isnan(line[name]) for name in ("q25", "q75", "iqm_low", "iqm_high"))
    assert all(math.isnan(x) for x in summaries.summarize(np.empty(0)).values())


@pytest.mark.parametrize("decimals", [0, 10])
def test_the_probability_of_improvement_is_the_statistic_of_mann_and_whitney(decimals):
    ours, others = OURS.round(decimals), OTHERS[:7].round(decimals)  # rounded values have ties
    found = summaries.improvement(ours, others)
    assert found.probability == pytest.approx(stats.mannwhitneyu(ours, others).statistic / (10 * 7))
    assert summaries.improvement(others, ours).probability == pytest.approx(1 - found.probability)

    def probability(x, y, axis=-1):
        x, y = x[..., :, None], y[..., None, :]
        return (0.5 * (x > y) + 0.5 * (x >= y)).mean(axis=(-2, -1))

    interval = stats.bootstrap((ours, others), probability, n_resamples=9999, method="percentile", rng=1)
    assert found[1:] == pytest.approx(tuple(interval.confidence_interval), abs=0.03)


def test_the_probability_of_improvement_needs_seeds():
    one = summaries.improvement(np.array([2.0]), np.array([1.0, 2.0]))
    assert one.probability == 0.75
    assert math.isnan(one.low)
    assert math.isnan(summaries.improvement(np.empty(0), OURS).probability)


def make_lines():
    finals = {"a_1": OURS, "b & c": OTHERS, "d": np.empty(0)}
    lines = [
        {"run": label} | summaries.summarize(x) | summaries.versus_first(finals, label, False) | {"seeds": len(x)}
        for label, x in finals.items()
    ]
    return lines, summaries.pairs(finals, is_higher_better=False)


def test_the_first_line_is_compared_with_the_others_in_the_direction_that_is_better():
    lines, pairs = make_lines()
    assert math.isnan(lines[0]["p_first"])
    assert lines[1]["p_first"] == pytest.approx(1 - summaries.improvement(OURS, OTHERS).probability)
    assert [(pair["better"], pair["than"]) for pair in pairs] == [("a_1", "b & c"), ("a_1", "d"), ("b & c", "d")]
    assert pairs[0]["probability"] == lines[1]["p_first"]


def test_summaries_are_written_as_csv_and_latex(tmp_path):
    lines, pairs = make_lines()
    files = summaries.write(tmp_path / "summary", lines, pairs)
    assert [path.name for path in files] == ["summary.csv", "summary.tex", "summary_improvement.csv"]
    with open(files[0], newline="") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["iqm"]) == pytest.approx(lines[0]["iqm"])
    assert (rows[0]["p_first"], rows[2]["median"], rows[2]["seeds"]) == ("", "", "0")
    latex = files[1].read_text()
    assert latex.count("\\toprule") == 1
    assert r"a\_1 & " in latex
    assert r"b \& c & $-$" in latex
    assert r"d & -- & -- & -- & 0" in latex
    assert latex.count(" & ") == 4 * 4 + 0


def test_the_text_has_a_header_and_aligned_columns():
    head, *lines = summaries.text(make_lines()[0]).splitlines()
    assert head.startswith("run ")
    assert "median [quartiles]" in head
    assert {len(line) for line in lines} == {len(head)}
    assert lines[2].split() == ["d", "-", "-", "-", "0"]


def test_final_levels_are_means_of_the_seeds_that_reach_the_end():
    x = np.arange(11.0)
    seeds = [Curve(x, 2 * x), Curve(x, x), Curve(x[:5], x[:5])]
    np.testing.assert_allclose(curves.final_levels(seeds, 8.0, 10.0), [18, 9])
    np.testing.assert_allclose(curves.final_levels(seeds, 8.0, 10.0, best_share=0.3), [18])
