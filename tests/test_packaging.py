"""The wheel contains everything that the commands need, and all files name the same version."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import jaxswarm

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_a_wheel_holds_all_modules_default_configs_and_the_page(tmp_path):
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(tmp_path), str(ROOT)]
    subprocess.run(command, check=True)
    wheel = tmp_path / f"jaxswarm-{jaxswarm.__version__}-py3-none-any.whl"
    names = set(zipfile.ZipFile(wheel).namelist())
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "jaxswarm").rglob("*.py")}
    configs = {f"jaxswarm/{path.relative_to(ROOT)}" for path in (ROOT / "configs").rglob("*.yaml")}
    curves = {str(path.relative_to(ROOT)) for path in (ROOT / "jaxswarm" / "data").rglob("*.csv")}
    assert modules | configs | curves | {"jaxswarm/render/replay.html", "jaxswarm/py.typed"} <= names
    assert not [name for name in names if name.startswith(("tests", "configs", "benchmarks"))]


@pytest.mark.parametrize(
    ("file", "pattern"),
    [("CITATION.cff", r"^version: (\S+)$"), ("README.md", r"^  version = \{(\S+)\},$")],
)
def test_citations_name_the_version_of_the_package(file, pattern):
    assert re.findall(pattern, (ROOT / file).read_text(), re.MULTILINE) == [jaxswarm.__version__]


def test_the_changelog_lists_the_version_of_the_package():
    assert f"\n## {jaxswarm.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_readme_has_one_test_command():
    """`.ci/run` extracts the block that starts with this fence line."""
    text = (ROOT / "README.md").read_text()
    (block,) = re.findall(r"^```sh test\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert block.splitlines()[-1].startswith("python -m pytest ")
