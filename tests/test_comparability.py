"""Runs with other values of a setting on which the return depends are compared by a metric that does not."""

import pytest

from jaxswarm import config as configs
from jaxswarm.analysis.comparability import Comparison, compare


def tasks(name, key, *values):
    return [configs.compose([f"task={name}", f"task.{key}={value}"])["task"] for value in values]


@pytest.mark.parametrize("key", ["num_agents=3,5", "torus=true,false", "dynamics=velocity,acceleration"])
def test_returns_are_compared_if_nothing_differs_that_changes_their_scale(key):
    name, _, values = key.partition("=")
    assert compare(tasks("rendezvous", name, *values.split(","))) == Comparison("return", True, ())
    assert compare([]).explain() == ""


def test_rendezvous_with_several_visibility_radii_is_compared_by_the_distance_to_the_center():
    comparison = compare(tasks("rendezvous", "visibility_radius", 10, 50, 10))
    assert comparison == Comparison("final_center_distance", False, ("visibility_radius",))
    assert comparison.better(3.0) == -3.0
    assert comparison.explain() == (
        "the return depends on task.visibility_radius; "
        "final_center_distance (lower is better) does not, and is compared instead"
    )


def test_the_first_metric_that_depends_on_no_setting_that_differs_is_chosen():
    radii, lengths = tasks("pursuit", "evader_visibility_radius", 10, 20), tasks("pursuit", "episode_length", 5, 6)
    assert compare(radii)[:2] == ("catches", True)
    assert compare([*radii, *lengths])[:2] == ("evader_distance", False)


def test_without_such_a_metric_the_return_is_not_comparable():
    different = [*tasks("rendezvous", "side", 50), *tasks("rendezvous", "side", 60)]
    assert compare([task | {"name": "unknown"} for task in different]) == Comparison()
    assert "declares no metric" in Comparison(settings=("side",)).explain()
