"""What is installed holds all that the commands need."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_a_wheel_holds_all_modules_default_configs_and_the_page(tmp_path):
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(tmp_path), str(ROOT)]
    subprocess.run(command, check=True)
    (wheel,) = tmp_path.glob("jaxswarm-*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "jaxswarm").rglob("*.py")}
    configs = {f"jaxswarm/{path.relative_to(ROOT)}" for path in (ROOT / "configs").rglob("*.yaml")}
    curves = {str(path.relative_to(ROOT)) for path in (ROOT / "jaxswarm" / "data").rglob("*.csv")}
    assert modules | configs | curves | {"jaxswarm/render/replay.html"} <= names
    assert not [name for name in names if name.startswith(("tests", "configs", "benchmarks"))]
