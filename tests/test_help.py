from unittest import mock

import pytest

import jaxswarm
from jaxswarm import config as configs
from jaxswarm.cli import figure, help, train
from jaxswarm.config import plugins


def rows(text, first):
    """Return the rows whose left text is `first`, with their wrapped descriptions joined."""
    rows = []
    for line in text.splitlines():
        if line.startswith(" " * help.COLUMN):
            rows[-1] += f" {line.strip()}"
        else:
            rows.append(" ".join(line.split()))
    return [row for row in rows if row.removeprefix("* ").split(" ")[0] == first]


def test_help_lists_all_choices_with_descriptions_and_marks_defaults():
    text = help.keys_help([])
    for group, names in configs.choices().items():
        for choice in names:
            (row,) = rows(text, f"{group}={choice}")
            assert row.removeprefix("* ") == f"{group}={choice} {configs.description(group, choice)}"
            assert row.startswith("*") == (configs.selection()[group] == choice)


def test_help_lists_all_keys_with_values_and_descriptions():
    text, config = help.keys_help(["aggregator=bayesian"]), configs.compose(["aggregator=bayesian"])
    described = configs.descriptions(config)
    keys = [key for key in configs.flat(config) if not key.endswith(".name")]
    for key in keys:
        (row,) = [row for row in text.splitlines() if row.startswith(f"  {key}=")]
        value = row.split()[0].partition("=")[2]
        assert key in configs.LENGTHS or configs.override(config, configs.parse([f"{key}={value}"])) == config
        assert rows(text, f"{key}={value}") == [f"{key}={value} {described[key].replace('`', '')}"]
    assert max(map(len, text.splitlines())) <= help.WIDTH


def test_help_of_an_experiment_has_its_keys_and_values():
    text = help.keys_help(["experiment=pursuit_multi_thesis", "num_steps=7"])
    for line in (
        "keys of task=pursuit_multi",
        "keys of aggregator=bayesian",
        "keys of learner=ppo_thesis",
        "keys of network=medium",
        "  task.num_agents=50 ",
        "  learner.batch_size=10200 ",
        "  network.encoder=[120,60] ",
        "  num_envs=20 ",
        "  num_steps=7 ",
        "  total_agent_steps=null ",
    ):
        assert f"\n{line}" in text
    assert "  * task=rendezvous " in text


def test_help_of_what_users_registered_is_read_from_their_docstrings(tmp_path, monkeypatch):
    monkeypatch.setattr(plugins, "have_run", set())
    (tmp_path / "mine.py").write_text('''
import jaxswarm
from jaxswarm.types import pytree

@pytree
class Priced(jaxswarm.TASKS["pursuit"]):
    """Agents pay for motion.

    Attributes:
        price: A step costs this price.
    """

    price: float = 0.5

@pytree
class Undocumented:
    num_agents: int = 2

jaxswarm.TASKS |= {"priced": Priced, "undocumented": Undocumented}
''')
    with mock.patch.dict(jaxswarm.TASKS):
        text = help.keys_help([f"imports={tmp_path / 'mine.py'}", "task=priced"])
    assert rows(text, "task=priced") == ["task=priced Agents pay for motion."]
    assert rows(text, "task.price=0.5") == ["task.price=0.5 A step costs this price."]
    assert len(rows(text, "task.num_evaders=1")[0]) > 30
    assert rows(text, "task=undocumented") == ["task=undocumented"]


@pytest.mark.parametrize(
    ("overrides", "part"), [(["task=pursuits"], "did you mean 'pursuit'"), (["num_worlds=3"], "renamed to num_envs")]
)
def test_help_on_what_does_not_exist_is_an_error(overrides, part, capsys):
    assert train.main([*overrides, "--help"]) == 2
    assert part in capsys.readouterr().err


def test_programs_print_this_help(capsys):
    assert train.main(["--help"]) == 0
    assert capsys.readouterr().out.endswith(f"\n{help.keys_help([])}\n")
    assert figure.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert rows(text, "fig_6_8") == ["fig_6_8 The figure compares three aggregators on assembly of four boxes."]
