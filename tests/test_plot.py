import csv
import math
import shutil
import xml.etree.ElementTree

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from jaxswarm import config as configs
from jaxswarm import files
from jaxswarm.analysis import legends, plots
from jaxswarm.analysis.curves import Line
from jaxswarm.cli import plot

SEEDS = {  # returns of the evaluations at 0, 500, 1000, ... agent steps
    "mean": {0: [-9.0, -5.0, -1.0], 1: [-8.0, -3.0, -2.0], 2: [-7.0, -6.0]},
    "max": {5: [-9.0, -8.0, -4.0], 6: [-9.0, -7.0, -3.0]},
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Return a folder with two groups of runs, one of three seeds and one of two seeds."""
    path = tmp_path_factory.mktemp("runs")
    config = configs.compose()
    for name, seeds in SEEDS.items():
        (path / name).mkdir()
        (path / name / "config.yaml").write_text(configs.dump(config | {"aggregator": {"name": name}}))
        rows = []
        for seed, values in seeds.items():
            for i, value in enumerate(values):
                row = {"update": i, "agent_steps": i * 500, "wall_seconds": i + seed / 8, "seed": seed}
                row |= {"eval/return": value, "learner/policy_loss": 1 / i if i else math.nan}
                rows.append(row)
        files.write_rows(path / name / "metrics.csv", rows)
    return path


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def reference(tmp_path):
    path = tmp_path / "figure.csv"
    lines = ["A (small),4,0,-8,-9,-7", "A (small),4,900,-1,,", "B,5,0,-7,-8,-6", "B,5,900,-2,-3,-1"]
    path.write_text("\n".join(["series,n_runs,agent_steps,median,q25,q75", *lines]) + "\n")
    return path


def read(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def text_of(path):
    """Return all text of an SVG plot."""
    return " ".join(" ".join(element.itertext()) for element in xml.etree.ElementTree.parse(path).iter())


def texts_of(path):
    """Return the texts of an SVG plot."""
    return [element.text for element in xml.etree.ElementTree.parse(path).iter() if (element.text or "").strip()]


def test_a_plot_of_a_folder_of_runs_says_how_many_seeds_and_what_the_band_is(runs, capsys):
    assert plot.main([str(runs), "out=a/b.svg"]) == 0
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        "aggregator=max: 2 seeds",
        "aggregator=mean: 3 seeds, 2 at the end",
        "wrote a/b.svg",
        "wrote a/b.csv",
    ]
    assert not err
    text = text_of("a/b.svg")
    expected = [
        "aggregator=mean (3 seeds, 2 at the end)",
        "aggregator=max (2 seeds)",
        "Median and quartiles over seeds",
    ]
    expected += ["rendezvous, ppo", "return of an episode", "thousand agent steps", "pale where not all seeds"]
    assert all(part in text for part in expected), text


def test_the_table_holds_what_is_drawn(runs):
    assert plot.main([str(runs), "out=x.svg"]) == 0
    rows = read("x.csv")
    assert list(rows[0]) == list(plots.COLUMNS)
    assert {(row["kind"], row["x_name"], row["y_name"]) for row in rows} == {
        ("curve", "agent_steps", "median of eval/return")
    }
    mean = [row for row in rows if row["series"] == "aggregator=mean"]
    assert [(float(row["x"]), int(row["num_seeds"])) for row in mean] == [(0, 3), (500, 3), (1000, 2)]
    values = [[float(row[name]) for name in ("lower", "y", "upper")] for row in mean]
    there = [[-9, -8, -7], [-5, -3, -6], [-1, -2]]
    np.testing.assert_allclose(values, [np.percentile(x, [25, 50, 75]) for x in there])


@pytest.mark.parametrize(("name", "start"), [("X.PNG", b"\x89PNG"), ("x.svg", b"<?xml"), ("a.b.pdf", b"%PDF")])
def test_the_suffix_is_the_format(runs, tmp_path, name, start):
    assert plot.main([str(runs / "mean"), f"out={name}"]) == 0
    path = tmp_path / name
    assert path.read_bytes().startswith(start)
    assert {x.name for x in tmp_path.iterdir()} == {name, path.with_suffix(".csv").name}


def test_the_same_plot_is_the_same_file(runs, tmp_path):
    files = []
    for _ in range(2):
        assert plot.main([str(runs), "out=x.svg", "statistic=iqm"]) == 0
        files.append((tmp_path / "x.svg").read_text())
    assert files[0] == files[1]
    assert "<dc:date>" not in files[0]


def test_a_previous_plot_is_replaced(runs, tmp_path):
    for group in ("mean", "max"):
        assert plot.main([str(runs / group)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"plot.png", "plot.csv"}
    assert {row["series"] for row in read("plot.csv")} == {"rendezvous, max, ppo"}


def test_the_interquartile_mean_over_the_time_with_logarithmic_axes(runs, capsys):
    overrides = ["statistic=iqm", "x=wall_seconds", "log=xy", "smooth=2", "title=What $ is_seen"]
    assert plot.main([str(runs), *overrides, "out=x.svg"]) == 0
    assert "cannot show wall_seconds = 0; number of points left out: 1" in capsys.readouterr().err
    text = text_of("x.svg")
    expected = ["What $ is_seen", "95 % stratified bootstrap interval", "means of 2 evaluations", "seconds"]
    assert all(part in text for part in expected), text
    assert "rendezvous" not in text
    rows = [row for row in read("x.csv") if row["series"] == "aggregator=max"]
    assert [float(row["x"]) for row in rows] == [0.625, 0.75, 1.625, 1.75, 2.625, 2.75]
    assert float(rows[1]["y"]) == pytest.approx((-9 + (-9 + 0.125 * 0.5)) / 2)


def test_another_column_may_be_drawn(runs, capsys):
    assert plot.main([str(runs / "max"), "y=learner/policy_loss", "x=update", "out=x.svg"]) == 0
    captured = capsys.readouterr()
    assert not captured.err
    assert [float(row["y"]) for row in read("x.csv")] == [1, 0.5]
    assert "learner/policy_loss" in text_of("x.svg")


def test_a_profile_of_the_last_evaluations(runs):
    assert plot.main([str(runs), "kind=profile", "out=x.svg"]) == 0
    rows = [row for row in read("x.csv") if row["series"] == "aggregator=mean"]
    points = {float(row["x"]): float(row["y"]) for row in rows}
    assert [points[x] for x in (-6, -4, -3, -2, -1)] == pytest.approx([2 / 3, 2 / 3, 2 / 3, 1 / 3, 0])
    assert max(points.values()) == 1
    text = text_of("x.svg")
    assert all(part in text for part in ("at 1,000 agent steps", "the first to end: 500 agent steps")), text


def test_the_times_to_a_threshold_with_seeds_that_never_got_there(runs, capsys):
    assert plot.main([str(runs), "kind=threshold", "threshold=-3.5", "out=x.svg"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "aggregator=max: 1 of 2 seeds, half by 1,000 agent steps"
    assert out[1] == "aggregator=mean: 2 of 3 seeds, half by 1,000 agent steps"
    rows = read("x.csv")
    assert [(row["series"], float(row["x"])) for row in rows if row["kind"] == "censored"] == [
        ("aggregator=max", 1000),
        ("aggregator=mean", 500),
    ]
    mean = {float(row["x"]): float(row["y"]) for row in rows if row["series"] == "aggregator=mean"}
    assert mean == pytest.approx({0: 0, 500: 1 / 3, 1000: 1})
    assert "2 of 3 seeds" in text_of("x.svg")


def test_references_are_drawn_with_their_source(runs, reference):
    assert plot.main([str(runs), f"reference={reference},{reference}", "series=small", "out=x.svg"]) == 0
    rows = [row for row in read("x.csv") if row["kind"] == "reference"]
    assert [row["series"] for row in rows] == ["A (small)"] * 4
    assert [(row["num_seeds"], row["x"], row["y"], row["lower"]) for row in rows[:2]] == [
        ("4", "0.0", "-8.0", "-9.0"),
        ("4", "900.0", "-1.0", ""),
    ]
    text = text_of("x.svg")
    assert "A (small) (figure, 4 runs)" in text
    assert "dashed: references, median and quartiles" in text


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (["kind=pie"], ["kind: must ", "got 'pie'", "curve, profile, threshold"]),
        (["statistic=mode"], ["statistic: must ", "got 'mode'", "median, iqm"]),
        (["x=time"], ["x: must ", "got 'time'", "wall_seconds"]),
        (["y=eval/retrun"], ["did you mean 'eval/return'", "learner/policy_loss"]),
        (["y=seed"], ["y: must ", "got 'seed'"]),
        (["log=z"], ["log: must ", "got 'z'", "x, y, xy"]),
        (["log=y", "y=update"], ["log: values of median of update must have one sign", "0 to 2"]),
        (["log=y", "kind=profile"], ["log: must be used with kind=curve, got kind=profile"]),
        (["kind=profile", "statistic=iqm"], ["statistic: must ", "got kind=profile"]),
        (["kind=profile", "seeds=true"], ["seeds: must ", "got kind=profile"]),
        (["seeds=3"], ["seeds: must ", "got '3'", "false, true"]),
        (["smooth=0"], ["smooth: must ", "got '0'", "an integer >= 1"]),
        (["kind=threshold"], ["threshold: must ", "got ''", "threshold=-30"]),
        (["threshold=3"], ["kind=threshold"]),
        (["out=x.jpg"], ["out: must ", "got 'x.jpg'", "FILE.png, FILE.svg, FILE.pdf"]),
        (["out="], ["out has no value"]),
        (["output=x.png"], ["unknown key 'output'", "did you mean 'out'"]),
        (["nowhere"], ["PATH: must be a run folder", "got 'nowhere'"]),
        (["reference=none.csv"], ["reference: cannot read none.csv", "No such file"]),
        (["reference={reference}", "series=C"], ["series: must ", "got 'C'", "A (small), B"]),
        (["reference={reference}", "x=update"], ["kind=curve and x=agent_steps"]),
        (["series=C"], ["must be used with reference"]),
        (["reference={runs}/mean/metrics.csv"], ["the file has no column series"]),
        (["out=figure.png"], ["would replace figure.csv"]),
    ],
)
def test_a_wrong_command_is_one_line_and_writes_nothing(runs, reference, tmp_path, capsys, overrides, parts):
    overrides = [word.format(reference=reference, runs=runs) for word in overrides]
    assert plot.main([str(runs), *overrides]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert all(part in captured.err for part in parts), captured.err
    assert list(tmp_path.iterdir()) == [reference]


def test_a_plot_that_is_not_ours_is_kept(runs, tmp_path, capsys):
    (tmp_path / "plot.png").write_text("a map of the garden")
    assert plot.main([str(runs)]) == 2
    assert "choose a name with out=" in capsys.readouterr().err
    assert (tmp_path / "plot.png").read_text() == "a map of the garden"


def test_a_command_without_runs_is_answered(capsys):
    assert plot.main([]) == 2
    assert plot.main(["--help"]) == 0
    assert "jaxswarm-plot PATH..." in capsys.readouterr().out
    assert plot.main(["log=x"]) == 2
    assert "give a run folder" in capsys.readouterr().err


def test_evaluations_that_are_not_finite_are_left_out_and_told(runs, tmp_path, capsys):
    folder = tmp_path / "diverged"
    folder.mkdir()
    (folder / "config.yaml").write_text((runs / "mean" / "config.yaml").read_text())
    (folder / "metrics.csv").write_text("update,agent_steps,seed,eval/return\n0,0,4,-9.0\n1,500,4,\n2,1000,4,inf\n")
    assert plot.main([str(folder), "out=x.png"]) == 0
    out, err = capsys.readouterr()
    assert err == f"warning: {folder}: number of evaluations left out because eval/return is not finite: 2\n"
    assert out.startswith("rendezvous, mean, ppo: 1 seed\n")
    assert [row["y"] for row in read("x.csv")] == ["-9.0"]


@pytest.mark.parametrize(("overrides", "count"), [([], 0), (["seeds=true"], 5), (["seeds=true", "smooth=2"], 5)])
def test_each_seed_is_shown_if_asked_for(runs, overrides, count):
    assert plot.main([str(runs), "out=x.svg", *overrides]) == 0
    assert plot.Path("x.svg").read_text().count("stroke-width: 0.6;") == count
    assert ("thin: each seed" in text_of("x.svg")) == (count > 0)


def test_many_series_share_no_color_and_marker():
    line = Line(*np.arange(12.0).reshape(4, 3), np.ones(3, int))
    series = [plots.Series(f"group {i}", line) for i in range(20)]
    many = plots.Plot("curve", series, "update", "y", "y")
    styles = []
    original = plots._draw_line
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plots, "_draw_line", lambda *arguments: (styles.append(arguments[-1]), original(*arguments)))
        plots.draw(plot.Path("many.svg"), many)
    assert len({(style["color"], style["marker"]) for style in styles}) == 20


def write_run(folder, overrides, seeds=(0,), **columns):
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(configs.dump(configs.compose(overrides)))
    starts = [{"update": i, "agent_steps": i * 500, "wall_seconds": 1.0 * i} for i in range(3)]
    rows = [row | {"seed": seed, "eval/return": -9.0 + row["update"]} for seed in seeds for row in starts]
    files.write_rows(folder / "metrics.csv", [row | columns for row in rows])


@pytest.mark.parametrize(
    ("seeds", "caption"),
    [
        ([(0,)], "One seed"),
        ([(0,), (1,)], "One seed per line"),
        ([(0, 1, 2), (0, 1, 2)], "Median and quartiles over 3 seeds"),
        ([(0, 1), (0,)], "Median and quartiles over seeds; lines of one seed have no band"),
    ],
)
def test_the_caption_fits_the_numbers_of_seeds(tmp_path, seeds, caption):
    for number, some in enumerate(seeds):
        write_run(tmp_path / "runs" / str(number), [f"learner.learning_rate={1e-3 * (1 + number)}"], some)
    assert plot.main(["runs", "out=x.svg"]) == 0
    texts = texts_of("x.svg")
    assert caption in texts
    is_in_legend = len(set(map(len, seeds))) > 1
    assert any("seed" in text for text in texts if text != caption) == is_in_legend


def test_each_task_and_each_reward_has_a_panel(tmp_path, capsys):
    for task in ("rendezvous", "pursuit", "pursuit_multi"):
        write_run(tmp_path / "runs" / task, [f"task={task}"])
    assert plot.main(["runs", "out=x.svg", "title=All tasks", "columns=2", "size=6x2"]) == 0
    panels = ["pursuit, mean, ppo, reward=distance", "pursuit, mean, ppo, reward=catches", "rendezvous, mean, ppo"]
    assert list(dict.fromkeys(row["panel"] for row in read("x.csv"))) == panels
    assert all(title in text_of("x.svg") for title in ["All tasks", *panels])
    assert f"{panels[-1]}; rendezvous, mean, ppo: 1 seed" in capsys.readouterr().out
    assert plot.main(["runs", "out=x.svg", "color=torus", "labels=num_agents"]) == 0
    assert {"torus=true", "torus=false"} <= set(texts_of("x.svg"))
    assert plot.main(["runs", "reference=" + str(tmp_path / "x.csv")]) == 2


def test_runs_with_other_visibility_radii_show_a_metric_that_does_not_depend_on_them(tmp_path, capsys):
    for radius in (10, 50):
        column = {"eval/final_center_distance": radius / 10}
        write_run(tmp_path / "new" / str(radius), [f"visibility_radius={radius}"], **column)
        write_run(tmp_path / "old" / str(radius), [f"visibility_radius={radius}"])
    assert plot.main(["new", "out=x.svg"]) == 0
    captured = capsys.readouterr()
    assert captured.out.startswith("the return depends on task.visibility_radius; final_center_distance (lower")
    assert {row["y_name"] for row in read("x.csv")} == {"median of eval/final_center_distance"}
    assert "eval/final_center_distance (lower is better)" in text_of("x.svg")
    assert plot.main(["new", "out=x.svg", "y=eval/return"]) == 0
    assert {row["y_name"] for row in read("x.csv")} == {"median of eval/return"}
    assert plot.main(["old", "out=x.svg"]) == 0
    assert "not comparable, but the runs have no column eval/final_center_distance" in capsys.readouterr().err
    assert {row["y_name"] for row in read("x.csv")} == {"median of eval/return"}


def test_labels_are_settings_or_names_of_folders(runs, tmp_path, capsys):
    for number, name in enumerate(("mean", "max")):
        write_run(tmp_path / "warm" / str(number), [f"init_from={runs / name}", f"aggregator={name}"], (number,))
    assert plot.main(["warm", "out=x.svg", "labels=init_from"]) == 0
    assert {row["series"] for row in read("x.csv")} == {"init_from=mean", "init_from=max"}
    assert plot.main(["warm", str(runs), "out=x.svg", "labels=run"]) == 0
    assert {row["series"] for row in read("x.csv")} == {"0", "1", "mean", "max"}
    capsys.readouterr()
    assert plot.main(["warm", "out=x.svg", "labels=learning_rate"]) == 2
    err = capsys.readouterr().err
    assert "labels: must differ between groups, got 'learning_rate=" in err
    assert "aggregator=mean, init_from=mean" in err


def test_lines_are_colored_by_a_setting(tmp_path):
    for number in range(10):
        overrides = [f"learner.learning_rate={1e-3 * (1 + number // 2)}", f"task.num_agents={5 + number % 2}"]
        write_run(tmp_path / "runs" / str(number), overrides)
    assert plot.main(["runs", "out=x.svg", "color=learning_rate"]) == 0
    texts = texts_of("x.svg")
    assert all(texts.count(f"learning_rate={x}") == 1 for x in ("0.001", "0.002", "0.003", "0.004", "0.005"))
    assert not any("num_agents" in text for text in texts)
    assert [text for text in texts if "learning_rate" in text] == sorted(x for x in texts if "learning_rate" in x)


@pytest.mark.parametrize("size", ["", "size=3.3", "size=3.3x2"])
@pytest.mark.parametrize("length", [10, 150])
def test_a_legend_of_many_labels_is_not_taller_than_the_plot(size, length):
    line = Line(*np.arange(12.0).reshape(4, 3), np.ones(3, int))
    series = [plots.Series(f"group {i} ".ljust(length, "x"), line) for i in range(40)]
    layout = plot.Options(size=size.removeprefix("size=")).layout
    _, _, height = layout.grid(1)
    figures = []
    with pytest.MonkeyPatch.context() as patch:
        draw_below = legends.draw_below
        patch.setattr(legends, "draw_below", lambda figure, *rest: (figures.append(figure), draw_below(figure, *rest)))
        plots.draw_panels(plot.Path("many.png"), [plots.Plot("curve", series, "update", "y", "y")], "", layout=layout)
    (figure,) = figures
    renderer = FigureCanvasAgg(figure).get_renderer()
    (legend,) = figure.legends
    assert legend.get_window_extent(renderer).height <= figure.axes[0].get_window_extent(renderer).height * 1.3
    assert legend.get_window_extent(renderer).width <= figure.bbox.width
    assert figure.get_figheight() <= 2 * height


@pytest.mark.parametrize("option", ["size=big", "size=3x", "size=0.1", "columns=0", "color=hue", "labels=name"])
def test_a_wrong_size_or_key_is_an_error(runs, capsys, option):
    assert plot.main([str(runs), option]) == 2
    assert f"{option.partition('=')[0]}: must be" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("column", "cell", "message"),
    [
        ("eval/return", "1e308", "no finite eval/return"),
        ("eval/return", "-inf", "no finite eval/return"),
        ("agent_steps", "9" * 400, "agent_steps: must be an integer of at most 9007199254740992"),
        ("agent_steps", "inf", "cannot read"),
    ],
)
def test_infinite_cells_are_refused(column, cell, message, runs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = shutil.copytree(next(path.parent for path in sorted(runs.rglob("config.yaml"))), tmp_path / "run")
    header, *lines = (folder / "metrics.csv").read_text().splitlines()
    index = header.split(",").index(column)
    lines = [",".join([*(cells := line.split(","))[:index], cell, *cells[index + 1 :]]) for line in lines]
    (folder / "metrics.csv").write_text("\n".join([header, *lines]) + "\n")
    assert plot.main(["run"]) == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
