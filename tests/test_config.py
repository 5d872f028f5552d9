import dataclasses
import sys
from unittest import mock

import jax
import jax.numpy as jnp
import pytest
from flax import linen as nn

import jaxswarm
from jaxswarm import AGGREGATORS, TASKS
from jaxswarm import config as configs
from jaxswarm.config import ConfigError, plugins
from jaxswarm.host.fit import fit


@pytest.mark.parametrize(
    "override", [f"{group}={choice}" for group, names in configs.choices().items() for choice in names]
)
def test_every_file_of_every_group_builds(override):
    config = configs.compose([override])
    for part in configs.REGISTERED:
        configs.build_part(part, config)


@pytest.mark.parametrize("network", configs.choices()["network"])
def test_every_network_builds_an_experiment(network):
    assert configs.build(configs.compose([f"network={network}"])).network.encoder


def test_groups_are_found_from_any_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert configs.compose(["network=medium"])["network"]["encoder"] == [120, 60]


def test_words_reach_the_experiment():
    overrides = ["aggregator=bayesian", "learner.learning_rate=1e-2", "task.num_agents=5", "task.side=50", "num_envs=8"]
    experiment = configs.build(configs.compose([*overrides, "learner.batch_size=80", "network.encoder=[7,8]"]))
    assert type(experiment.network.aggregator).__name__ == "Bayesian"
    assert (experiment.learner.learning_rate, experiment.learner.batch_size) == (0.01, 80)
    assert (experiment.task.num_agents, experiment.num_envs, experiment.network.encoder) == (5, 8, (7, 8))
    assert isinstance(experiment.task.side, float)  # an integer leaf would compile another program


def test_a_field_needs_no_prefix_where_only_one_part_has_it():
    overrides = [
        "learner=trl",
        "projection=kl",
        "mean_bound=0.03",
        "cov_bound=0.001",
        "regression_coefficient=8",
        "num_agents=7",
    ]
    config = configs.compose(overrides)
    assert config == configs.compose(
        [f"learner.{override}" if i in (1, 2, 3, 4) else override for i, override in enumerate(overrides)]
    )
    assert (config["learner"]["projection"], config["task"]["num_agents"]) == ("kl", 7)


def test_the_thesis_setting_has_the_thesis_arithmetic():
    config = configs.compose(["experiment=rendezvous_thesis"])
    experiment = configs.build(config)
    learner, per_update = experiment.learner, experiment.agent_steps_per_update
    assert per_update == 164_000
    assert configs.run_settings(config).length(per_update) * per_update == 26_240_000
    assert per_update // learner.batch_size * learner.num_epochs == 1640
    assert (learner.learning_rate, learner.adam_epsilon, learner.bootstrap_truncation) == (3e-4, 1e-5, False)
    assert experiment.task.relative_velocity == "thesis"


def test_trust_region_layers_are_configured_by_words():
    overrides = ["learner=trl", "learner.projection=kl", "learner.mean_bound=0.05", "learner.regression_coefficient=8"]
    experiment = configs.build(configs.compose([*overrides, "network.std=state"]))
    learner = experiment.learner
    assert (learner.projection, learner.mean_bound, learner.cov_bound, learner.regression_coefficient) == (
        "kl",
        0.05,
        1e-3,
        8.0,
    )
    assert experiment.network.std == "state"
    experiment = configs.build(configs.compose(["experiment=rendezvous_thesis", "learner=trl_thesis"]))
    assert (experiment.learner.objective, experiment.learner.projection) == ("raw", "wasserstein")


def test_words_win_over_an_experiment():
    config = configs.compose(["experiment=rendezvous_thesis", "learner=ppo", "num_envs=16", "total_agent_steps=5"])
    assert config["learner"]["sampling_unit"] == "envs"
    assert (config["num_envs"], config["num_updates"], config["total_agent_steps"]) == (16, None, 5)


def test_a_length_in_agent_steps_is_rounded_up():
    assert [configs.RunSettings(total_agent_steps=n).length(100) for n in (1, 100, 101)] == [1, 1, 2]


def test_a_written_config_reads_back_the_same(tmp_path):
    config = configs.compose(["aggregator=bayesian", "aggregator.prior_mean=null", "learner.learning_rate=1e-5"])
    (tmp_path / "config.yaml").write_text(configs.dump(config))
    assert configs.load(tmp_path / "config.yaml") == config


def test_fields_that_no_file_mentions_get_their_defaults():
    config = configs.compose()
    del config["task"]["side"], config["reset_pool"]
    checked = configs.validate(config)
    assert checked["task"]["side"] == 100.0
    assert "reset_pool" in checked


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("taks=rendezvous", ["'taks'", "did you mean 'task'"]),
        ("num_env=3", ["did you mean 'num_envs'", "num_steps"]),
        ("learning_rat=3", ["did you mean 'learner.learning_rate'"]),
        ("num_world=3", ["unknown key 'num_world' (did you mean 'num_envs'?)"]),
        ("init_from=[a,b]", ["init_from", "text"]),
        ("learning_rate=fast", ["learner.learning_rate: must ", "got 'fast'"]),
        ("name=ppo", ["name: must be one of task.name, aggregator.name, learner.name, got 'name'"]),
        ("learner.learning_rat=3", ["did you mean 'learner.learning_rate'", "learner.clip_range"]),
        ("seed.x=3", ["'seed.x'"]),
        ("task=rendevous", ["did you mean 'rendezvous'", ", rendezvous"]),
        ("learner=x", ["'x'", "one of ppo, ppo_thesis"]),
        ("task.name=x", ["task.name", "'x'", "rendezvous"]),
        ("learner.learning_rate=fast", ["learner.learning_rate", "'fast'", "a number"]),
        ("learner.learning_rate=nan", ["nan", "a number"]),
        ("num_envs=2.5", ["num_envs", "2.5", "an integer"]),
        ("num_envs=true", ["True", "an integer"]),
        ("total_agent_steps=1e6", ["an integer", "write 1000000"]),
        ("task.torus=1", ["task.torus", "true or false"]),
        ("learner=trl_thesi", ["did you mean 'trl_thesis'", "ppo_thesis"]),
        ("network.std=none", ["'none'", "shared, state"]),
        ("network.activation=gelu", ["'gelu'", "leaky_relu, relu, tanh"]),
        ("network.encoder=64", ["64", "a list of integers"]),
        ("network.encoder=[a]", ["network.encoder[0]", "an integer"]),
        ("network.decoder=[64,0]", ["network.decoder: must ", "got [64, 0]", "integers >= 1"]),
        ("network.encoder=[]", ["encoder: must ", "got ()", "at least one layer"]),
        ("task={a: 1}", ["task: must ", "got {'a': 1}"]),
        ("foo", ["'foo'", "key=value"]),
        ("seed=1,2", ["'seed=1,2'", "one value"]),
        ("+seed=1", ["'+seed=1'", "key=value"]),
        ("~seed", ["'~seed'", "key=value"]),
        ("num_envs=0", ["num_envs: must ", "got 0"]),
        ("task.num_agents=0", ["num_agents: must ", "got 0"]),
        ("task.visibility_radius=-1", ["visibility_radius: must ", "got -1.0"]),
        ("learner.batch_size=77", ["batch_size: must ", "got 77", "divide"]),
        ("learner.batch_size=1000000", ["batch_size: must ", "got 1000000"]),
        ("aggregator=null", ["aggregator: must ", "got None", "bayesian"]),
        ("seed=-1", ["seed: must ", "got -1"]),
        ("num_updates=0", ["num_updates: must ", "got 0"]),
        ("keep_checkpoints=0", ["keep_checkpoints: must ", "got 0"]),
    ],
)
def test_what_is_wrong_is_named_in_one_line_with_what_is_accepted(override, parts):
    def use():
        config = configs.compose([override])
        configs.run_settings(config)
        configs.build(config)

    with pytest.raises(ConfigError) as caught:
        use()
    message = str(caught.value)
    assert all(part in message for part in parts), message
    assert "\n" not in message


def test_two_lengths_at_once_are_refused():
    config = configs.compose(["num_updates=3", "total_agent_steps=4"])
    with pytest.raises(ConfigError, match="num_updates and total_agent_steps: exactly one must be set, got 3 and 4"):
        configs.run_settings(config)


def test_run_settings_are_the_keys_beside_the_experiment():
    run = configs.run_settings(configs.compose(["seed=7", "num_updates=3", "checkpoint_seconds=1"]))
    assert dataclasses.asdict(run) == {
        "seed": 7,
        "num_seeds": 1,
        "num_updates": 3,
        "total_agent_steps": None,
        "checkpoint_seconds": 1.0,
        "keep_checkpoints": 3,
        "render_every": None,
        "loggers": (),
        "init_from": None,
        "imports": (),
    }


def test_heads_have_to_share_the_width():
    overrides = ["aggregator=attentive", "aggregator.num_heads=2"]
    assert configs.build(configs.compose([*overrides, "network.encoder=[65,8]"]))
    for encoder in ("[65]", "[8] network.shared_encoder=[65]"):
        with pytest.raises(ConfigError, match="num_heads: must divide the message width 65, got 2"):
            configs.build(configs.compose([*overrides, *f"network.encoder={encoder}".split()]))


OWN = """
import jaxswarm
from jaxswarm.aggregators.monoids import Mean
from jaxswarm.tasks import Rendezvous
from jaxswarm.types import pytree

@pytree
class Costly(Rendezvous):
    price: float = 0.5

class Average(Mean):
    pass

jaxswarm.TASKS["costly"] = Costly
jaxswarm.AGGREGATORS["average"] = Average
"""


@pytest.fixture
def registries(monkeypatch):
    """Restore the registries after the test."""
    monkeypatch.setattr(plugins, "have_run", set())
    with mock.patch.dict(TASKS), mock.patch.dict(AGGREGATORS):
        yield


def test_files_of_a_user_register_choices(registries, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    overrides = ["imports=mine.py", "experiment=rendezvous_thesis", "task=costly", "aggregator=average", "price=2"]
    config = configs.compose([*overrides, "num_agents=5"])
    experiment = configs.build(config)
    assert (type(experiment.task).__name__, experiment.task.price, experiment.task.num_agents) == ("Costly", 2.0, 5)
    assert type(experiment.network.aggregator).__name__ == "Average"
    assert experiment.num_envs == 10
    assert config["imports"] == [str(tmp_path / "mine.py")]
    assert "costly" in configs.choices()["task"]
    with pytest.raises(ConfigError, match=r"did you mean 'task.price'"):
        configs.compose(["imports=mine.py", "task=costly", "task.prize=2"])


def test_a_run_brings_its_imports(registries, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(OWN)
    config = configs.compose([f"imports=[{tmp_path / 'mine.py'}]", "task=costly"])
    plugins.keep(config["imports"], tmp_path)
    (tmp_path / "config.yaml").write_text(configs.dump(config))
    TASKS.pop("costly")
    monkeypatch.setattr(plugins, "have_run", set())
    assert configs.load(tmp_path / "config.yaml") == config
    assert configs.build(config).task.price == 0.5


def test_files_import_what_is_beside_them_and_modules_what_is_here(registries, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "beside.py").write_text("class Priced: pass")
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "mine.py").write_text(OWN)
    (tmp_path / "other.py").write_text("import jaxswarm, beside\njaxswarm.TASKS['priced'] = beside.Priced\n")
    configs.compose([f"imports={tmp_path / 'other.py'}"])
    assert TASKS.pop("priced").__module__ == "beside"
    monkeypatch.chdir(tmp_path)
    assert configs.compose(["imports=package.mine", "task=costly"])["imports"] == ["package.mine"]


def test_a_run_folder_keeps_the_files_that_it_needs(registries, tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    (tmp_path / "mine.py").write_text(OWN)
    (tmp_path / "run" / "mine.py").write_text("")  # has the same name
    config = configs.compose([f"imports=[{tmp_path / 'mine.py'},{tmp_path / 'run' / 'mine.py'}]", "task=costly"])
    plugins.keep(config["imports"], tmp_path / "run")
    (tmp_path / "run" / "config.yaml").write_text(configs.dump(config))
    (tmp_path / "mine.py").unlink()
    TASKS.pop("costly")
    monkeypatch.setattr(plugins, "have_run", set())
    assert configs.load(tmp_path / "run" / "config.yaml") == config
    assert configs.build(config).task.price == 0.5


@pytest.mark.slow
def test_run_folders_of_fit_name_the_files_of_a_users_task(registries, tmp_path):
    (tmp_path / "mine.py").write_text(OWN)
    overrides = [
        f"imports={tmp_path / 'mine.py'}",
        "task=costly",
        "num_agents=3",
        "task.episode_length=5",
        "num_envs=2",
    ]
    experiment = configs.build(configs.compose([*overrides, "num_steps=4", "learner.batch_size=12", "num_eval_envs=2"]))
    fit(experiment, 1, run_dir=tmp_path / "run", progress=False)
    assert configs.read(tmp_path / "run" / "config.yaml")["imports"] == [str(tmp_path / "mine.py")]
    assert [path.name for path in (tmp_path / "run" / "imports").iterdir()] == ["0-mine.py"]


def test_presets_are_experiments_in_python_too():
    experiment = jaxswarm.experiment("experiment=pursuit_best", "task.num_agents=20")
    overrides = ["experiment=pursuit_best", "task.num_agents=20"]
    assert jax.tree.structure(experiment) == jax.tree.structure(configs.build(configs.compose(overrides)))
    assert (type(experiment.task).__name__, experiment.task.num_agents) == ("Pursuit", 20)


def run_fields(config):
    return {
        field.name: config[field.name] for field in dataclasses.fields(configs.RunSettings) if field.name != "imports"
    }


@pytest.mark.parametrize(
    "override", [f"{group}={choice}" for group, names in configs.choices().items() for choice in names]
)
def test_every_experiment_is_described_by_the_config_it_was_made_of(override):
    config = configs.compose([override, *["batch_size=null"] * override.startswith("learner=")])
    assert configs.describe(configs.build(config), **run_fields(config)) == config


def test_experiments_of_a_user_are_described_with_their_imports(registries, tmp_path):
    (tmp_path / "mine.py").write_text(OWN)
    config = configs.compose([f"imports={tmp_path / 'mine.py'}", "task=costly", "price=3"])
    assert configs.describe(configs.build(config), **run_fields(config)) == config


def test_numbers_of_arrays_are_described():
    experiment = configs.build(configs.compose())
    learner = experiment.learner.replace(learning_rate=jnp.float32(0.25))
    config = configs.describe(experiment.replace(learner=learner), num_updates=3)
    assert (config["learner"]["learning_rate"], config["num_updates"], config["total_agent_steps"]) == (0.25, 3, None)


@pytest.mark.parametrize("change", ["class", "network", "fields", "length"])
def test_what_no_config_can_say_has_no_description(change):
    experiment, num_updates = configs.build(configs.compose()), 3
    if change == "class":
        own = type("Own", (jaxswarm.TASKS["rendezvous"],), {})
        experiment = experiment.replace(task=own())
    if change == "network":
        experiment = experiment.replace(network=nn.Dense(3))
    if change == "fields":
        rates = experiment.learner.replace(learning_rate=jnp.array([1e-3, 1e-2]))
        experiment = experiment.replace(learner=rates)
    if change == "length":
        num_updates = 0
    assert configs.describe(experiment, num_updates=num_updates) is None


@pytest.mark.parametrize(
    ("text", "part"), [(None, "FileNotFoundError"), ("1 / 0", "ZeroDivisionError"), ("def", "SyntaxError")]
)
def test_an_import_that_fails_is_named(registries, tmp_path, text, part):
    path = tmp_path / "mine.py"
    if text:
        path.write_text(text)
    with pytest.raises(ConfigError, match=f"cannot import {path}: {part}"):
        configs.compose([f"imports={path}"])


@pytest.mark.slow
def test_what_aggregators_cannot_share_is_said_before_training():
    overrides = ["task=pursuit", "aggregator=concat", "network.latent_space=shared"]
    with pytest.raises(ConfigError, match=r"latent_space: must be separate for the groups evaders, neighbors"):
        configs.build(configs.compose(overrides))


def test_imports_are_names():
    with pytest.raises(ConfigError, match="cannot import 3"):
        configs.compose(["imports=3"])


@pytest.mark.parametrize("name", ["läufe", "lr=0.1", "run(1)", "a,b", "C#", "a~b", "实验"])
def test_paths_are_taken_literally(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert configs.compose([f"init_from={name}/base"])["init_from"] == str(tmp_path / name / "base")
    (tmp_path / f"{name}.py").write_text("import jaxswarm\n")
    assert configs.compose([f"imports={name}.py"])["imports"] == [str(tmp_path / f"{name}.py")]
