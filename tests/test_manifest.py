"""Content of the manifest of new and resumed runs."""

import json

import jaxlib
import pytest

from jaxswarm import config
from jaxswarm.host import manifest


def test_the_manifest_has_versions_device_and_the_arithmetic_of_steps(tmp_path):
    experiment = config.build(config.compose(["experiment=rendezvous_thesis"]))
    path = tmp_path / "manifest.json"
    manifest.write_manifest(path, manifest.describe(experiment, 160, [4]))
    written = json.loads(path.read_text())
    assert written["seeds"] == [4]
    assert written["versions"]["jaxlib"] == jaxlib.__version__
    assert written["device"]["backend"]
    steps = written["steps"]
    assert (steps["agent_steps_per_update"], steps["agent_steps"]) == (164_000, 26_240_000)
    assert (steps["environment_steps"], steps["evaluations"]) == (1_312_000, 161)
    assert (steps["gradient_steps_per_update"], steps["gradient_steps"]) == (1640, 262_400)


def test_the_manifest_of_a_resumed_run_keeps_the_earlier_ones(tmp_path):
    for i in range(3):
        manifest.write_manifest(tmp_path / "m.json", {"session": i})
    written = json.loads((tmp_path / "m.json").read_text())
    assert written == {"session": 2, "earlier_sessions": [{"session": 0}, {"session": 1}]}


@pytest.mark.parametrize("text", ["", "[]", "3", '"x"', '{"earlier_sessions": 3}'])
def test_a_damaged_manifest_is_replaced(tmp_path, text):
    (tmp_path / "m.json").write_text(text)
    manifest.write_manifest(tmp_path / "m.json", {"session": 1})
    assert json.loads((tmp_path / "m.json").read_text())["session"] == 1
