"""Estimates of memory and time, compared with compiled programs, and the refusal of what cannot fit."""

import time

import numpy as np
import pytest

import jaxswarm
from jaxswarm import config as configs
from jaxswarm.config import ConfigError
from jaxswarm.host import ensemble, estimate
from jaxswarm.host.fit import fit


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ("task.num_agents=100000", "task.num_agents"),
        ("task=pursuit num_evaders=1000000", "task.num_evaders"),
        ("num_eval_envs=2147483647", "num_eval_envs"),
        ("reset_pool=2147483647", "reset_pool"),
        ("task.episode_length=2147483647", "task.episode_length"),
        ("learner.num_epochs=2147483647", "learner.num_epochs"),
        ("network.encoder=[65536,65536]", "network.encoder"),
        ("aggregator=histogram num_distances=10000 num_bearings=10000", "aggregator.num_distances"),
    ],
)
def test_what_cannot_fit_is_refused_within_seconds(words, key, monkeypatch):
    monkeypatch.setattr(estimate, "free_memory", lambda: 8.0 * 2**30)
    experiment, start = jaxswarm.experiment(*words.split()), time.process_time()
    with pytest.raises(ConfigError, match=rf"{key}: must be small enough for the memory, got .* GiB are available"):
        fit(experiment, 1)
    assert time.process_time() - start < 5


def test_many_seeds_need_memory_for_their_states(monkeypatch):
    monkeypatch.setattr(estimate, "free_memory", lambda: 2.0**30)
    with pytest.raises(ConfigError, match="num_seeds: must be small enough for the memory, got 60000"):
        estimate.check_training(jaxswarm.experiment(), 60_000)
    estimate.check_training(jaxswarm.experiment(), 100)


def test_many_episodes_are_refused(monkeypatch):
    monkeypatch.setattr(estimate, "free_memory", lambda: 2.0**30)
    with pytest.raises(ConfigError, match=r"episodes: must be small enough .*an evaluation needs at least"):
        estimate.check_episodes(jaxswarm.make("rendezvous"), 10**9)
    with pytest.raises(ConfigError, match=r"task.num_agents: must be small enough"):
        estimate.check_episodes(jaxswarm.make("rendezvous", num_agents=100_000))


def test_slow_training_is_reported_with_an_estimate(monkeypatch):
    said = []
    experiment = jaxswarm.experiment("num_agents=1000", "network.encoder=[512,512]")
    monkeypatch.setattr(estimate, "free_memory", lambda: 2.0**40)
    estimate.check_training(experiment, 1, 2, said.append)
    (line,) = said
    assert line.startswith("warning: training will be slow, at least about ")
    assert line.endswith(" in all; task.num_agents is 1000")


@pytest.mark.parametrize("name", [name for name in configs.choices()["experiment"] if name.endswith("_best")])
def test_our_presets_fit_and_are_not_slow(name, monkeypatch):
    monkeypatch.setattr(estimate, "free_memory", lambda: 4.0 * 2**30)
    experiment = jaxswarm.experiment(f"experiment={name}")
    estimate.check_training(experiment, 4, 1, pytest.fail)


def test_durations_have_a_unit():
    assert [estimate._duration(x) for x in (3.0, 150.0, 8000.0, 200_000.0)] == [
        "3 seconds",
        "2 minutes",
        "2 hours",
        "2 days",
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
@pytest.mark.parametrize("words", ["", "task=pursuit num_agents=60 num_envs=8", "network.encoder=[512] num_envs=8"])
def test_the_estimate_is_at_most_what_the_compiled_program_needs(words):
    experiment = jaxswarm.experiment(*words.split())
    sizes = estimate.training_sizes(experiment, 1)
    shapes = estimate._shapes(sizes, experiment.task, experiment.network)
    estimated = sum(estimate.training_memory(experiment, shapes, 1))
    run = ensemble.make_batch([experiment], 1)._replace(mesh=None)
    states = ensemble.abstract_state(experiment)
    program = ensemble._advance.lower(run.experiments, states, np.int32(0), 2, 1, None).compile()
    needed = ensemble._memory(program)
    assert 0.05 * needed < estimated < 1.2 * needed
