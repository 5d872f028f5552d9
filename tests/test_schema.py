import dataclasses
import re
import subprocess
import sys

import pytest

from jaxswarm import config as configs
from jaxswarm.config import groups, schema

CHOICES = [(group, choice) for group, names in configs.choices().items() for choice in names]
FILES = [str(path.relative_to(configs.config_dir())) for path in configs.config_dir().rglob("*.yaml")]


@dataclasses.dataclass
class Base:
    """A base.

    Attributes:
        width: The width has
            two lines.
        height: This text is replaced.
    """

    width: int
    height: int


@dataclasses.dataclass
class Derived(Base):
    """A class
    with a summary of two lines.

    Attributes:
        height: The height is new: with a colon.

    Raises:
        ValueError: Never.
    """

    depth: int = 1


def test_descriptions_are_read_from_the_class_and_its_bases():
    assert schema.descriptions(Derived) == {
        "width": "The width has two lines.",
        "height": "The height is new: with a colon.",
    }


def test_the_summary_is_the_first_paragraph():
    assert schema.summary(Derived) == "A class with a summary of two lines."
    assert not schema.summary(dataclasses.make_dataclass("Undocumented", ["x"]))


@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_every_key_of_every_choice_has_a_description_of_whole_sentences(group, choice):
    described = configs.descriptions(configs.compose([f"{group}={choice}"]))
    assert {key: text for key, text in described.items() if not re.fullmatch(r"[A-Z].*[^ ]\.", text)} == {}


@pytest.mark.parametrize("name", FILES)
def test_every_file_has_a_description_of_one_or_two_sentences(name):
    description = groups.read_yaml(configs.config_dir() / name)["description"]
    assert re.fullmatch(r"[A-Z0-9].*[^ ]\.", description)
    assert len(re.findall(r"\. (?=[A-Z\"])", description)) < 2


@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_descriptions_of_files_are_no_part_of_a_config(group, choice):
    config = configs.compose([f"{group}={choice}"])
    assert not [key for key in configs.flat(config) if key.endswith("description")]
    assert group == "experiment" or "description" not in configs.preset(group, choice)


def test_importing_the_config_package_is_cheap():
    program = """if True:
        import sys, jaxswarm.config
        assert not {"jax", "hydra", "omegaconf", "docstring_parser"} & sys.modules.keys()
    """
    subprocess.run([sys.executable, "-c", program], check=True)
