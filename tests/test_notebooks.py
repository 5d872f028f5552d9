"""The notebooks are stored without outputs, open in Colab, install jaxswarm if needed, and run from top to bottom."""

import ast
from pathlib import Path

import nbformat
import pytest

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
REPOSITORY = "https://github.com/jaxswarm/jaxswarm"
COLAB = f"https://colab.research.google.com/github/{REPOSITORY.removeprefix('https://github.com/')}/blob/main/notebooks"
SMALL = {"num_agents": 3, "episode_length": 6, "num_updates": 2, "num_envs": 2}
TINY = {  # assigned after the cell with the tag `parameters`
    "quickstart": SMALL,
    "compare_aggregators": SMALL | {"aggregators": ("max",), "num_seeds": 2},
    "write_a_task": SMALL,
    "write_an_aggregator": SMALL | {"num_seeds": 2},
    "swarm_size": SMALL | {"sizes": (3, 5)},
}


@pytest.fixture(params=TINY)
def name(request):
    return request.param


def read(name):
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", 4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def parameters(notebook):
    (cell,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    return cell


def test_all_notebooks_are_tested():
    assert {path.stem for path in NOTEBOOKS.iterdir() if path.suffix == ".ipynb"} == TINY.keys()


def test_notebooks_are_valid_and_hold_no_results(name):
    notebook = read(name)
    nbformat.validate(notebook)
    assert notebook.metadata.keys() <= {"kernelspec", "language_info"}
    for cell in code_cells(notebook):
        assert not cell.outputs
        assert cell.execution_count is None
        assert cell.metadata.keys() <= {"tags"}


def test_notebooks_open_in_colab(name):
    title = read(name).cells[0].source
    assert title.startswith("# ")
    assert f"({COLAB}/{name}.ipynb)" in title


def test_the_readme_lists_all_notebooks(name):
    text = (NOTEBOOKS.parent / "README.md").read_text()
    assert f"(notebooks/{name}.ipynb)" in text
    assert f"({COLAB}/{name}.ipynb)" in text


def test_the_first_code_installs_where_it_is_needed(name):
    source = code_cells(read(name))[0].source
    assert 'find_spec("jaxswarm") is None' in source
    assert f'%pip install -q "jaxswarm @ git+{REPOSITORY}"' in source


def test_tiny_sizes_replace_parameters_and_nothing_else(name):
    """Every parameter has a tiny value, except the seed and the aggregator."""
    assigned = {node.targets[0].id: node.value for node in ast.parse(parameters(read(name)).source).body}
    assert TINY[name].keys() <= assigned.keys()
    assert assigned.keys() - TINY[name].keys() <= {"seed", "aggregator"}


def test_links_between_notebooks_lead_somewhere(name):
    for cell in (cell for cell in read(name).cells if cell.cell_type == "markdown"):
        for link in cell.source.split("](")[1:]:
            target = link[: link.index(")")]
            assert target.startswith("https://") or (NOTEBOOKS / target).exists()


@pytest.mark.slow
@pytest.mark.usefixtures("few_optimizations")
def test_notebooks_run(name, tmp_path, monkeypatch):
    client = pytest.importorskip("nbclient")
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setenv("JAX_NUMPY_RANK_PROMOTION", "raise")  # as in all other tests
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=0")  # compiling takes most of the time
    notebook = read(name)
    cell = parameters(notebook)
    cell.source = "\n".join([cell.source, *(f"{key} = {value!r}" for key, value in TINY[name].items())])
    client.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    assert "Warning" not in "".join(map(str, outputs))
    results = [output for output in outputs if "data" in output]
    assert any("image/png" in output.data for output in results)
    if name in ("quickstart", "write_a_task", "swarm_size"):
        assert any("iframe" in output.data.get("text/html", "") for output in results)
