"""Figures of the thesis: configs compared with its numbers, claims on synthetic curves, and one figure end to end."""

import dataclasses
import functools
import json
import math
import shutil

import jax
import numpy as np
import pytest

from jaxswarm import config as configs
from jaxswarm.analysis import curves
from jaxswarm.analysis.curves import Curve, Line
from jaxswarm.cli import figure as program
from jaxswarm.config import ConfigError
from jaxswarm.figures import figure as figures
from jaxswarm.figures import report
from jaxswarm.figures.claims import KINDS, Claim, Measured, judge
from jaxswarm.studies import execution

MEDIUM, SIMPLE = ((120, 60), (160,), "leaky_relu"), ((64,), (64,), "leaky_relu")
MEAN_OPT, ATTENTIVE = ((174, 226, 96), (97,), "relu"), ((72,), (132, 200), "leaky_relu")
RENDEZVOUS_OPT = ((146, 120), (19, 177, 162), "tanh")
CLUSTERING_OPT = ((146, 120), (60, 177, 162), "leaky_relu")

# Runs of the thesis: agent steps per iteration, batch size, iterations; for each series the number of environments,
# aggregator, learner, network and number of parameters. Where the thesis's data does not contain the number of
# environments, it is 20 here.
RUNS = {
    "fig_6_1": (164_000, 1000, 160, {
        "Bayes agg. (medium)": (10, "bayesian", "ppo", MEDIUM, 52_405),
        "Mean agg. (medium)": (10, "mean", "ppo", MEDIUM, 37_645),
        "Bayes agg. (simple)": (10, "bayesian", "ppo", SIMPLE, 11_461),
        "Mean agg. (simple)": (10, "mean", "ppo", SIMPLE, 10_053),
        "Bayes agg. (opt)": (10, "bayesian", "ppo", RENDEZVOUS_OPT, 143_623),
        "Mean agg. (opt)": (10, "mean", "ppo", RENDEZVOUS_OPT, 107_863),
    }),
    "fig_6_3": (102_000, 10_200, 500, {
        "Bayesian agg.": (20, "bayesian", "ppo", MEDIUM, 100_485),
        "Mean agg.": (20, "mean", "ppo", MEDIUM, 70_965),
        "Attentive agg.": (20, "attentive", "ppo", ATTENTIVE, 177_885),
    }),
    "fig_6_4": (102_000, 1020, 500, {
        "Bayesian agg.": (20, "bayesian", "ppo", SIMPLE, 19_909),
        "Mean agg.": (20, "mean", "ppo", SIMPLE, 18_117),
        "Attentive agg.": (20, "attentive", "ppo", SIMPLE, None),
    }),
    "fig_6_5": (102_000, 10_200, 500, {
        "Bayesian agg.": (20, "bayesian", "ppo", MEDIUM, 100_485),
        "Mean agg.": (20, "mean", "ppo", MEAN_OPT, 286_780),
        "Attentive agg.": (20, "attentive", "ppo", ATTENTIVE, 177_885),
        "Max Agg.": (10, "mean", "ppo", MEAN_OPT, 286_780),
    }),
    "fig_6_6": (102_000, 10_200, 500, {
        "Bayesian agg.": (20, "bayesian", "ppo", MEDIUM, 100_485),
        "Mean agg.": (20, "mean", "ppo", MEAN_OPT, 286_780),
        "Attentive agg.": (20, "attentive", "ppo", ATTENTIVE, 177_885),
    }),
    "fig_6_8": (256_000, 5120, 200, {
        "Bayesian agg.": (20, "bayesian", "ppo", MEDIUM, 102_725),
        "Mean agg.": (20, "mean", "ppo", MEDIUM, 73_205),
        "Attentive agg.": (20, "attentive", "ppo", ATTENTIVE, 179_517),
    }),
    "fig_6_9": (256_000, 10_240, 500, {
        "Mean agg.": (20, "mean", "ppo", MEDIUM, 108_845),
        "Bayesian agg.": (20, "bayesian", "ppo", MEDIUM, 153_125),
        "Attentive agg.": (20, "attentive", "ppo", ATTENTIVE, 241_725),
    }),
    "fig_6_10": (102_000, 10_200, 500, {
        "PPO, Bayesian agg.": (20, "bayesian", "ppo", MEDIUM, 100_485),
        "PPO, Mean agg.": (20, "mean", "ppo", MEAN_OPT, 286_780),
        "TRL, Bayesian Agg.": (20, "bayesian", "trl", MEDIUM, 100_485),
        "TRL, Mean Agg.": (10, "mean", "trl", MEAN_OPT, 286_780),
    }),
    "fig_6_11": (102_000, 10_200, 500, {
        "PPO, Bayesian agg.": (20, "bayesian", "ppo", MEDIUM, 100_485),
        "PPO, Mean agg.": (20, "mean", "ppo", MEDIUM, 70_965),
        "TRL, Bayesian agg.": (20, "bayesian", "trl", MEDIUM, 100_485),
        "TRL, Mean agg.": (20, "mean", "trl", MEDIUM, 70_965),
    }),
    "fig_6_12": (256_000, 5120, 200, {
        "PPO, Bayesian agg.": (20, "bayesian", "ppo", MEDIUM, 102_725),
        "PPO, Mean agg.": (20, "mean", "ppo", MEDIUM, 73_205),
        "PPO, Attentive agg.": (20, "attentive", "ppo", ATTENTIVE, 179_517),
        "TRL, Bayesian agg.": (20, "bayesian", "trl", MEDIUM, 102_725),
        "TRL, Mean agg.": (20, "mean", "trl", MEDIUM, 73_205),
        "TRL, Attentive agg.": (20, "attentive", "trl", ATTENTIVE, 179_517),
    }),
    "fig_6_14_pursuit": (102_000, 10_200, 500, {
        "Bayesian agg. (single space)": (10, "bayesian", "ppo", MEDIUM, 81_045),
        "Bayesian agg. (sep. spaces)": (20, "bayesian", "ppo", MEDIUM, 100_485),
        "Bayesian agg. (single space, small)": (20, "bayesian", "ppo", SIMPLE, None),
        "Bayesian agg. (sep. spaces, small)": (20, "bayesian", "ppo", SIMPLE, 19_909),
    }),
    "fig_6_14_assembly": (256_000, 5120, 200, {
        "Bayesian agg. (single space)": (20, "bayesian", "ppo", MEDIUM, 83_285),
        "Bayesian agg. (sep. spaces)": (20, "bayesian", "ppo", MEDIUM, 102_725),
    }),
    "fig_6_15": (102_000, 10_200, 500, {
        "μ only": (20, "bayesian", "ppo", MEDIUM, 100_485),
        "μ+σ²": (20, "bayesian", "ppo", MEDIUM, 138_885),
    }),
    "clustering_3": (1_280_000, 10_240, 500, {
        "Mean agg. (medium)": (10, "mean", "trl", MEDIUM, None),
        "Mean agg. (mean-opt)": (10, "mean", "trl", (*MEAN_OPT[:2], "leaky_relu"), None),
        "Bayesian agg.": (10, "bayesian", "trl", CLUSTERING_OPT, None),
    }),
    "fig_max_true": (102_000, 10_200, 500, {
        "Bayesian agg.": (20, "bayesian", "ppo", MEDIUM, 100_485),
        "Mean agg.": (20, "mean", "ppo", MEAN_OPT, 286_780),
        "Max Agg.": (20, "max", "ppo", MEDIUM, 70_965),
    }),
}  # fmt: skip
BEST = [f"best_{task}" for task in configs.choices()["task"]]  # figures that are not in the thesis
LEARNING = {"learning_rate": 3e-4, "adam_epsilon": 1e-5, "num_epochs": 10, "bootstrap_truncation": False}
TINY = [
    *("task.num_agents=3", "task.num_evaders=1", "task.episode_length=5", "num_envs=2", "num_steps=4"),
    *("learner.batch_size=12", "num_eval_envs=2", "network.encoder=[4]", "network.decoder=[4]"),
]


@functools.cache
def observation(task):
    """Return the shapes of an observation. The cache saves time, because tasks with boxes trace slowly."""
    return jax.eval_shape(lambda key: task.observe(task.reset(key)), jax.random.key(0))


@functools.cache
def compose(overrides):
    return configs.compose(overrides)


def num_parameters(experiment, counted={}):  # noqa: B006
    """Return the number of parameters of actor and critic. Networks with the same features are counted only once."""
    obs, network = observation(experiment.task), experiment.network
    features = {name: group.features.shape[-1] for name, group in obs.groups.items()}
    key = (network, obs.own.shape[-1], tuple(sorted(features.items())))
    if key not in counted:
        shapes = jax.eval_shape(network.init, jax.random.key(0), obs)
        counted[key] = sum(math.prod(x.shape) for x in jax.tree.leaves(shapes))
    return counted[key]


def test_every_figure_is_in_the_table():
    assert RUNS.keys() | set(BEST) == set(figures.names())
    assert not {configs.FIGURES, configs.SEARCHES} & configs.choices().keys()


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "fig_6_1" else pytest.mark.slow) for name in RUNS]
)
def test_every_series_is_what_was_run(name):
    per_update, batch_size, num_updates, expected = RUNS[name]
    figure = figures.load_figure(name)
    assert list(figure.series) == list(expected)
    for series, (num_envs, aggregator, learner, network, count) in expected.items():
        config = compose(figure.series[series])
        run = configs.build(config)
        assert (config["aggregator"]["name"], config["learner"]["name"]) == (aggregator, learner)
        assert run.num_envs * run.num_steps * run.task.num_agents == per_update
        assert (run.num_envs, run.learner.batch_size) == (num_envs, batch_size)
        assert configs.run_settings(config).length(per_update) == num_updates >= figure.num_updates
        assert (run.network.encoder, run.network.decoder, run.network.activation) == network
        assert run.network.latent_space == ("shared" if "single space" in series else "separate")
        assert {field: getattr(run.learner, field) for field in LEARNING} == LEARNING
        assert (run.eval_every, run.num_eval_envs, run.desynchronized_start) == (1, 20, False)
        assert count is None or count == num_parameters(run), series


@pytest.mark.parametrize("name", BEST)
def test_our_own_settings_are_shorter_than_the_curve_beside_them(name):
    figure, thesis_preset = figures.load_figure(name), (f"experiment={name.removeprefix('best_')}_thesis",)
    assert figure.references.keys() == (set() if name == "best_clustering_3" else figure.series.keys())
    thesis = configs.build(compose(thesis_preset))
    in_thesis = configs.run_settings(compose(thesis_preset)).num_updates * thesis.agent_steps_per_update
    for series, overrides in figure.series.items():
        run, settings = configs.build(compose(overrides)), configs.run_settings(compose(overrides))
        end = figure.num_updates * run.agent_steps_per_update
        assert settings.length(run.agent_steps_per_update) + 1 == figure.num_updates
        assert end < (figure.references[series].x[-1] if figure.references else in_thesis)
        fields = {"num_agents": run.task.num_agents, "episode_length": run.task.episode_length}
        assert fields == {"num_agents": thesis.task.num_agents, "episode_length": thesis.task.episode_length}
        assert type(run.task) is type(thesis.task)


def test_tasks_are_those_of_the_thesis():
    def task(name):
        return configs.build(compose(next(iter(figures.load_figure(name).series.values())))).task

    rendezvous, one, several = task("fig_6_1"), task("fig_6_3"), task("fig_6_5")
    assert (rendezvous.num_agents, rendezvous.torus, rendezvous.relative_velocity) == (20, False, "thesis")
    assert [(x.num_agents, x.num_evaders, x.reward) for x in (one, several)] == [
        (10, 1, "distance"),
        (50, 5, "catches"),
    ]
    two, three = task("fig_6_9"), task("clustering_3")
    assert [(x.num_agents, x.num_boxes, x.reward) for x in (two, three)] == [(10, 4, "amplified"), (20, 12, "corners")]
    assert task("fig_6_8").episode_length == 512


@pytest.mark.parametrize("name", sorted(RUNS.keys() - {"clustering_3"}))
def test_the_thesis_reproduces_its_own_claims(name):
    figure = figures.load_figure(name)
    assert figure.references.keys() == figure.series.keys()
    per_update = RUNS[name][0]
    assert max(line.x[-1] for line in figure.references.values()) == figure.num_updates * per_update
    theirs = figures.thesis_measured(figure)
    outcomes = {claim.says: judge(claim, theirs, theirs, enough=1).outcome for claim in figure.claims}
    assert set(outcomes.values()) == {"reproduced"}, outcomes


def test_final_levels_and_steps_are_those_that_the_thesis_was_measured_to_have():
    pursuit = figures.thesis_measured(figures.load_figure("fig_6_11"))
    steps = [pursuit[name].steps_to(0.9) / 1e6 for name in pursuit]
    np.testing.assert_allclose(steps, [8.0, 7.5, 7.0, 4.7], atol=0.1)
    several = figures.thesis_measured(figures.load_figure("fig_6_5"))
    finals = [several[name].final() for name in ("Bayesian agg.", "Mean agg.", "Attentive agg.", "Max Agg.")]
    np.testing.assert_allclose(finals, [31.7, 37.7, 20.0, 37.5], atol=0.06)
    best = figures.thesis_measured(figures.load_figure("fig_6_6"))
    np.testing.assert_allclose([best[name].final() for name in best], [42.2, 47.3, 28.3], atol=0.06)


def ramp(final, steps, end=100.0, num_seeds=16):
    """Return a line that rises linearly from 0 to `final` at `steps`, with quartiles 2 apart."""
    x = np.arange(1.0, end + 1)
    y = final * np.minimum(x / steps, 1)
    return Line(x, y, y - 1, y + 1, np.full(len(x), num_seeds))


def measured(line, end=100.0):
    return Measured(line, line, end)


SERIES = {"a": measured(ramp(10.0, 40.0)), "b": measured(ramp(8.0, 20.0)), "c": measured(ramp(4.0, 80.0))}


@pytest.mark.parametrize(
    ("kind", "series", "fields", "expected"),
    [
        ("final", "a", {}, 10.0),
        ("lower_quartile", "a", {}, 9.0),
        ("difference", "ac", {}, 6.0),
        ("spread", "bac", {}, 6.0),
        ("overlap", "ab", {}, 0.0),
        ("overlap", "ac", {}, -4.0),
        ("level", "ab", {"at": 20.0}, 5.0),
        ("lead", "bac", {"at": 10.0}, 1.5),
        ("steps", "a", {"fraction": 0.51}, 21.0),
        ("pace", "ca", {"fraction": 0.51}, 2.0),
    ],
)
def test_each_kind_of_claim_is_a_number(kind, series, fields, expected):
    assert Claim("", kind, tuple(series), **fields).number(SERIES) == pytest.approx(expected, abs=0.15)


def test_every_kind_is_in_a_figure():
    assert {claim.kind for name in RUNS for claim in figures.load_figure(name).claims} == KINDS.keys()


@pytest.mark.parametrize(
    ("line", "high", "outcome"),
    [
        (ramp(10.0, 40.0), 11.0, "reproduced"),
        (ramp(10.0, 40.0), 9.0, "not reproduced"),
        (ramp(10.0, 40.0, num_seeds=15), 11.0, "not enough runs"),
        (ramp(10.0, 40.0, end=90.0), 11.0, "run was cut"),
    ],
)
def test_verdicts_say_what_can_be_said(line, high, outcome):
    claim = Claim("", "final", ("a",), high=high)
    verdict = judge(claim, {"a": measured(line)}, SERIES, enough=16)
    assert (verdict.outcome, verdict.num_seeds) == (outcome, line.num_seeds[0])
    assert (verdict.here, verdict.thesis) == (pytest.approx(10.0), pytest.approx(10.0))
    assert judge(claim, {}, SERIES, enough=16).outcome == "not enough runs"


def test_a_level_that_is_never_reached_is_no_evidence():
    low = dataclasses.replace(SERIES["a"], line=ramp(2.0, 40.0))
    claim = Claim("", "steps", ("a",), fraction=0.9)
    assert math.isnan(claim.number({"a": low}))
    assert judge(claim, {"a": low}, SERIES, enough=16).outcome == "not reproduced"


def test_never_is_longer_than_any_time():
    never = dataclasses.replace(SERIES["c"], line=ramp(2.0, 40.0))
    claim = Claim("", "pace", ("a", "b"), fraction=0.9)
    assert claim.number({"a": SERIES["a"], "b": never}) == 0
    assert claim.number({"a": never, "b": SERIES["a"]}) == math.inf
    assert math.isnan(claim.number({"a": never, "b": never}))
    cut = dataclasses.replace(never, line=ramp(2.0, 40.0, end=50.0))
    assert math.isnan(claim.number({"a": cut, "b": SERIES["a"]}))


def test_the_range_of_what_is_never_reached_is_never():
    never = dataclasses.replace(SERIES["c"], line=ramp(2.0, 40.0), bootstrapped=(ramp(2.0, 40.0),) * 10)
    ours = {"a": never, "b": dataclasses.replace(SERIES["a"], bootstrapped=(SERIES["a"].line,) * 10)}
    verdict = judge(Claim("", "pace", ("a", "b"), fraction=0.9, high=1.0), ours, SERIES, enough=16)
    assert (verdict.outcome, verdict.here, verdict.interval) == ("not reproduced", math.inf, (math.inf, math.inf))


@pytest.mark.parametrize(
    ("kind", "fields", "outcome"),
    [
        ("level", {"at": 50.0}, "reproduced"),
        ("level", {"at": 70.0}, "run was cut"),
        ("steps", {"fraction": 0.9}, "reproduced"),
        ("final", {}, "run was cut"),
    ],
)
def test_claims_about_the_beginning_need_no_more_than_that(kind, fields, outcome):
    series = {"a": measured(ramp(10.0, 40.0, end=60.0))}
    series["a"] = dataclasses.replace(series["a"], reference=ramp(10.0, 40.0))
    assert judge(Claim("", kind, ("a",), high=100.0, **fields), series, SERIES, enough=16).outcome == outcome


@pytest.mark.parametrize(
    ("spread", "room", "outcome"),
    [(0.0, 0.5, "reproduced"), (5.0, 0.5, "seeds disagree"), (0.1, -1.0, "not reproduced")],
)
def test_verdicts_require_that_bootstrapped_seeds_agree(spread, room, outcome):
    rng, x = np.random.default_rng(0), np.arange(1.0, 101)
    seeds = [Curve(x, np.full(100, 10 + spread * noise)) for noise in rng.normal(size=16)]
    line = curves.summarize(seeds, "median")
    one = Measured(line, line, 100.0, tuple(curves.bootstrapped(seeds, "median", 200, rng)))
    verdict = judge(Claim("", "final", ("a",), high=line.y[0] + room), {"a": one}, SERIES, enough=16)
    assert verdict.outcome == outcome
    low, high = verdict.interval
    assert low <= verdict.here <= high
    expected = np.percentile([np.median(rng.choice([s.y[0] for s in seeds], 16)) for _ in range(2000)], [10, 90])
    np.testing.assert_allclose([low, high], expected, atol=0.2 * spread + 1e-9)


@pytest.fixture
def trained(tmp_path):
    """Return a function that writes a run folder of figure 6.15's first series as if these seeds had been trained."""

    def write(name, seed, num_seeds, level=1.0, **changes):
        overrides = figures.load_figure("fig_6_15").series["μ only"]
        changes |= {"seed": seed, "num_seeds": num_seeds}
        config = configs.compose([*overrides, *(f"{key}={value}" for key, value in changes.items())])
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").write_text(configs.dump(config))
        manifest = {"git_revision": "0123456789abcdef", "device": {"backend": "cpu"}}
        (tmp_path / name / "manifest.json").write_text(json.dumps(manifest))
        rows = [
            f"{u},{102_000 * u},0,{s},{level + s}" for u in range(0, 400, 100) for s in range(seed, seed + num_seeds)
        ]
        text = "\n".join(["update,agent_steps,wall_seconds,seed,eval/return", *rows, ""])
        (tmp_path / name / "metrics.csv").write_text(text)
        return tmp_path / name

    return write


def seeds_of(trials):
    return [trial.settings.seeds for trial in trials]


def test_only_seeds_that_are_missing_are_trained(trained, tmp_path):
    figure = figures.load_figure("fig_6_15")

    def plan(num_seeds):
        return figures.plan(figure, tmp_path, figures.find_runs(tmp_path), num_seeds)["μ only"]

    assert seeds_of(plan(4)) == [(0, 1, 2, 3)]
    first, second = trained("first", 0, 2), trained("second", 5, 1)
    trained("coarse", 2, 1, eval_every=100)
    assert seeds_of(plan(4)) == [(0, 1), (2, 3)]
    trials = plan(8)
    assert seeds_of(trials) == [(0, 1), (5,), (2, 3, 4), (6, 7)]
    assert [trial.run_dir for trial in trials[:2]] == [first, second]
    larger = trained("larger", 0, 8)
    assert [trial.run_dir for trial in plan(8)] == [larger]
    assert [trial.run_dir for trial in plan(2)] == [larger]


def test_a_seed_that_two_folders_hold_counts_once(trained, tmp_path):
    figure = figures.load_figure("fig_6_15")
    for name, level in (("one", 1.0), ("other", 1.0001)):
        trained(name, 0, 4, level)
    found = figures.find_runs(tmp_path)
    ours = figures.measure(figure, figures.plan(figure, tmp_path, found), found, lambda text: None)
    assert ours["μ only"].num_seeds == 4


def test_of_the_best_third_of_seeds_only_these_are_shown(trained, tmp_path):
    figure = dataclasses.replace(figures.load_figure("fig_6_15"), best_share=1 / 3, num_seeds=6)
    trained("six", 0, 6)  # the return of seed s is 1 + s
    found = figures.find_runs(tmp_path)
    ours = figures.measure(figure, figures.plan(figure, tmp_path, found), found, lambda text: None)["μ only"]
    assert (ours.num_seeds, figure.num_shown) == (2, 2)
    np.testing.assert_allclose([ours.line.lower[0], ours.line.y[0], ours.line.upper[0]], [5.25, 5.5, 5.75])
    rng = np.random.default_rng(1)
    expected = [np.median(np.sort(rng.integers(1, 7, 6))[-2:]) for _ in range(4000)]
    assert np.mean([line.y[0] for line in ours.bootstrapped]) == pytest.approx(np.mean(expected), abs=0.15)


def test_a_report_is_not_replaced_by_an_empty_one(tmp_path, capsys):
    (tmp_path / "report.md").write_text("precious")
    assert program.main(["all", f"dir={tmp_path / 'typo'}", f"out={tmp_path}"]) == 2
    assert "typo holds no run folder" in capsys.readouterr().err
    assert (tmp_path / "report.md").read_text() == "precious"


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
def test_folders_of_no_figure_are_told(trained, tmp_path, capsys):
    trained("mine", 0, 2)
    odd = trained("odd", 0, 2, num_envs=40, num_steps=51)
    (odd / "config.yaml").write_text((odd / "config.yaml").read_text() + "gone: 1\n")  # a key of another version
    assert program.main(["all", f"dir={tmp_path}", f"out={tmp_path / 'out'}"]) == 0
    assert f"warning: {odd} belongs to no figure" in capsys.readouterr().err
    report = (tmp_path / "out" / "report.md").read_text()
    assert "| μ only | 2 |" in report
    assert "The runs on cpu used these revisions of the code: 0123456789ab." in report
    kept = tmp_path / "out" / "runs" / "mine"
    assert {path.name for path in kept.iterdir()} == {"config.yaml", "manifest.json", "metrics.csv"}
    assert not (kept.parent / "odd").exists()
    shutil.rmtree(tmp_path / "mine")  # the folder of the report contains everything that it needs
    shutil.rmtree(tmp_path / "odd")
    assert program.main(["all", f"dir={tmp_path}", f"out={tmp_path / 'out'}"]) == 0
    assert (tmp_path / "out" / "report.md").read_text() == report
    assert capsys.readouterr().err == ""


def test_finished_sections_of_an_earlier_report_stay():
    sections = ["## a: One\n\nDone.\n", f"## b: Two\n\n{report.NOT_RUN}\n", "## c: Three\n\n| x |\n"]
    found = report.finished_sections(report.page(sections, []))
    assert found == {"a": sections[0], "c": sections[2]}


def test_what_is_kept_of_a_run_is_all_that_reports_read(trained, tmp_path):
    figure, whole = figures.load_figure("fig_6_15"), trained("whole", 0, 2)
    (folder,) = figures.find_runs(tmp_path)
    figures.keep_results(folder, tmp_path / "kept")
    (kept,) = figures.find_runs(tmp_path / "kept")
    assert (kept.config, kept.rows) == (folder.config, folder.rows)
    assert figures.origin(kept) == figures.origin(folder)
    for found in ([folder], [kept]):
        (trial, *_) = figures.plan(figure, tmp_path, found, num_seeds=2)["μ only"]
        assert trial.run_dir == found[0].path
    text = (whole / "metrics.csv").read_text()
    (whole / "metrics.csv").write_text(text + "400,40800000,0,0,1\n")
    (longest,) = figures.find_runs(tmp_path / "kept", tmp_path)
    assert longest.path == whole


def test_equal_series_of_figures_share_a_run_and_scale_shortens_it(tmp_path):
    (first,) = figures.plan(figures.load_figure("fig_6_5"), tmp_path, scale=0.1)["Bayesian agg."]
    (second,) = figures.plan(figures.load_figure("fig_6_15"), tmp_path)["μ only"]
    assert first.run_dir == second.run_dir
    assert (first.num_updates, second.num_updates) == (40, 343)
    assert (first.settings.num_seeds, second.settings.num_seeds) == (16, 16)


def test_wrong_overrides_are_errors(capsys):
    with pytest.raises(ConfigError, match="fig_6_1, "):
        figures.load_figure("fig_9_9")
    for overrides, message in [
        (["fig_9_9"], "figure: must be one of all, "),
        (["fig_6_15", "scale=2"], "a number above 0"),
        (["fig_6_15", "seeds=0"], "an integer >= 1"),
        (["fig_6_15", "series=mu*"], "'μ only', 'μ+σ²'"),
        (["fig_6_15", "num_seeds=2"], "write seeds=N"),
        (["all", "seeds=3"], "all trains nothing"),
    ]:
        assert program.main(overrides) == 2
        assert message in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
def test_a_figure_is_run_continued_and_reported(tmp_path, monkeypatch, capsys):
    overrides = ["fig_6_15", "seeds=2", f"dir={tmp_path}", *TINY]
    real, lengths = execution.train, []

    def train(together):
        lengths.append(together[0].num_updates)
        return real(together)

    monkeypatch.setattr(execution, "train", train)
    assert program.main([*overrides, "scale=0.006", "series=*only"]) == 0
    assert "not enough runs" in capsys.readouterr().out
    assert program.main([*overrides, "scale=0.006"]) == 0  # trains the other one
    assert "run was cut" in capsys.readouterr().out
    assert program.main([*overrides, "scale=0.006"]) == 0  # nothing is left to train
    assert program.main([*overrides, "scale=0.01"]) == 0  # resumes in the same folders
    assert lengths == [3, 3, 4, 4]
    folders = {path.name for path in tmp_path.iterdir() if path.is_dir()}
    assert len(folders) == 2
    names = ("fig_6_15", "fig_6_15_summary")
    files = {"fig_6_15.png", "fig_6_15.md", "fig_6_15_summary.tex", *(f"{name}.csv" for name in names)}
    assert files <= {path.name for path in tmp_path.iterdir()}
    monkeypatch.setattr(figures, "names", lambda: ["fig_6_5", "fig_6_15"])
    assert program.main(["all", f"dir={tmp_path}", f"out={tmp_path / 'out'}", *TINY]) == 0
    report = (tmp_path / "out" / "report.md").read_text()
    assert "| Bayesian agg. | 2 | 0.0 |" in report  # from the run of the other figure
    assert "| Mean agg. | 0 | not run |" in report
    assert program.main(["all", f"dir={tmp_path}", f"out={tmp_path / 'out'}"]) == 0
    assert "| Bayesian agg. | 2 | 0.0 |" in (tmp_path / "out" / "report.md").read_text()  # the earlier section stays
