"""The module levels: a module imports only from lower levels, and the two wings do not meet before the rollout."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxswarm

PACKAGE = Path(jaxswarm.__file__).parent
LEVELS = [
    {"limits", "types", "plot_settings", "scene", "files", "config.renamed"},
    {"checks", "config.schema"},
    {"registry"},
    {"physics.geometry", "physics.contacts", "aggregators.sets", "distributions", "export.program"},
    {"config.plugins", "config.settings", "config.overrides"},
    {"physics.dynamics", "physics.neighbors", "physics.collisions", "aggregators.monoids", "aggregators.attentive"},
    {"physics.rigid2d", "tasks.swarm", "tasks.evasion", "aggregators.features", "physics", "bridges.gymnax"},
    {"tasks.rendezvous", "tasks.pursuit", "tasks.arena", "aggregators", "bridges", "export"},
    {"tasks.boxes", "networks"},
    {"tasks"},
    {"rollout"},
    {"learners.on_policy"},
    {"learners.projections"},
    {"learners.ppo", "learners.trl"},
    {"learners"},
    {"training", "config.groups"},
    {"config.keys"},
    {"config.composition", "config.conversion"},
    {"config", "host.checkpoint", "host.progress", "host.manifest", "host.ensemble", "host.metrics_log"},
    {"host.identity"},
    {"analysis.curves", "analysis.comparability", "analysis.legends", "render.film", "host.loggers", "host.estimate"},
    {"analysis.plots", "analysis.summaries", "render.page", "render.pictures"},
    {"analysis.training_curve", "analysis.run_folders", "render"},
    {"analysis"},
    {"host.run"},
    {"host.divergence", "host.resume", "host.trained", "host.signals"},
    {"host.recorder"},
    {"host.batch_recorder"},
    {"host.fit"},
    {"host"},
    {"studies.search", "studies.execution", "figures.claims"},
    {"studies.grid", "figures.figure"},
    {"figures.report"},
    {"studies", "figures"},
    {"cli.program", "cli.help"},
    {"cli.policy_options", "cli.plot_options"},
    {"cli.train", "cli.evaluate", "cli.plot", "cli.render", "cli.export"},
    {"cli.sweep", "cli.figure"},
    {"cli"},
]
LEVEL = {module: number for number, level in enumerate(LEVELS) for module in level}
WINGS = ({"physics", "tasks"}, {"distributions", "aggregators", "networks"})
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
    if path != PACKAGE / "__init__.py"
}


def imports(path):
    """Return the modules of this package that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] == "jaxswarm" and len(parts) > 1:
                yield next(m for m in (".".join(parts[1:3]), parts[1]) if m in MODULES)


def test_every_module_has_a_level():
    assert MODULES.keys() == LEVEL.keys()


@pytest.mark.parametrize("module", MODULES)
def test_imports_come_from_lower_levels(module):
    assert all(LEVEL[imported] < LEVEL[module] for imported in imports(MODULES[module]))


@pytest.mark.parametrize(("wing", "other"), [WINGS, WINGS[::-1]])
def test_wings_do_not_meet(wing, other):
    for module, path in MODULES.items():
        if module.split(".")[0] in wing:
            assert not {name.split(".")[0] for name in imports(path)} & other


def test_only_distributions_imports_distrax():
    assert [name for name, path in MODULES.items() if "import distrax" in path.read_text()] == ["distributions"]


def test_importing_touches_no_device():
    program = """if True:
        import jax, jaxswarm
        from jaxswarm import train
        assert not jax._src.xla_bridge.backends_are_initialized()
    """
    subprocess.run([sys.executable, "-c", program], check=True)
