"""Values that are too large or of another type are refused with their key, before anything is traced."""

import numpy as np
import pytest
import yaml

import jaxswarm
from jaxswarm import config as configs
from jaxswarm.config import ConfigError, overrides, renamed, schema

TOO_LARGE = "must be an integer of at most 2147483647, got"


def refusal(*words):
    def use():
        config = configs.compose(words)
        configs.run_settings(config)
        configs.build(config)

    with pytest.raises(ConfigError) as caught:
        use()
    return str(caught.value)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("num_envs=2147483648", f"num_envs: {TOO_LARGE} 2147483648"),
        ("task.num_agents=99999999999999999999", f"task.num_agents: {TOO_LARGE} 99999999999999999999"),
        ("num_updates=2147483648", f"num_updates: {TOO_LARGE} 2147483648"),
        ("task.active_agents=[2,2147483648]", f"task.active_agents[1]: {TOO_LARGE} 2147483648"),
        ("seed=4294967296", "seed: must be an integer of at most 4294967295, got 4294967296"),
        ("num_seeds=100000000", "num_seeds: must be a number from 1 to 65536, got 100000000"),
        ("task.num_agents=1000001", "task.num_agents: must be an integer of at most 1000000, got 1000001"),
        ("task=pursuit num_evaders=1000001", "task.num_evaders: must be an integer of at most 1000000, got 1000001"),
        ("task=assembly num_boxes=1000000", "task.num_boxes: must be an integer of at most 1000, got 1000000"),
        ("network.encoder=[1000000000]", "network.encoder: must be a tuple of integers from 1 to 65536"),
        ("aggregator=histogram num_bearings=10001", "aggregator.num_bearings: must be an integer of at most 10000"),
        ("task.side=1e30", "task.side: must be a finite number from -1e+12 to 1e+12, got 1e+30"),
        ("learner=trl target_entropy=-1e30", "learner.target_entropy: must be a finite number from -1e+12 to 1e+12"),
        ("checkpoint_seconds=inf", "checkpoint_seconds: must be a finite number from"),
        (f"network.encoder=[{'1,' * 64}1]", "network.encoder: must have at most 64 elements, got 65"),
        ("learner.name={a:1}", "learner.name: must be one of ppo, trl, got {'a': 1}"),
        ("task.name=[1]", "task.name: must be one of rendezvous, pursuit, assembly, clustering, got [1]"),
        ("init_from=[null]", "init_from: must be text or null, got [None]"),
        ("loggers=tensorboard", "got 'tensorboard' (write [tensorboard])"),
        ("network.encoder=64", "got 64 (write [64])"),
        ("learning_rate=[1e-3,1e-4]", "got [0.001, 0.0001] (the values of a sweep have no brackets)"),
        ("aggregator=attentive num_heads=7", "aggregator.num_heads: must divide the message width 64, got 7"),
        ("learner.projection=kl", "learner.projection: must be used with learner=trl or learner=trl_thesis"),
        ("num_boxes=3", "task.num_boxes: must be used with task=assembly or task=clustering_2 or task=clustering_3"),
        ("learner.lr=0.1", "unknown key 'learner.lr' (did you mean 'learner.learning_rate'?)"),
        ("gamma=0.9", "unknown key 'gamma' (did you mean 'learner.discount'?)"),
        ("clip_eps=0.2", "unknown key 'clip_eps' (did you mean 'learner.clip_range'?)"),
    ],
)
def test_a_wrong_value_is_refused_with_its_key(words, message):
    assert message in refusal(*words.split())


def test_more_updates_than_a_counter_holds_are_refused():
    run = configs.run_settings(configs.compose(["total_agent_steps=9999999999999"]))
    with pytest.raises(ConfigError, match=r"total_agent_steps: must be at most 51539607528, .*got 9999999999999"):
        run.length(24)
    assert run.length(81_920) == 122_070_313


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("learner: {name: {a: 1}}", "learner.name: must be one of ppo, trl, got {'a': 1}"),
        ("task: {name: [1]}", "task.name: must be one of rendezvous, "),
        ("imports: [1, 2]", "imports[0]: must be text, got 1"),
        ("num_envs: 2147483648", "num_envs: must be an integer of at most 2147483647"),
        ("network: 3", "network: must be a mapping of fields, got 3"),
    ],
)
def test_a_stored_config_is_refused_alike(text, message, tmp_path):
    config, change = configs.compose(), yaml.safe_load(text)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config | change))
    with pytest.raises(ConfigError) as caught:
        configs.load(tmp_path / "config.yaml")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "value", ["glob(*)", "[glob(*)]", "{a:glob(*)}", "range(1,3)", "interval(1,2)", "[choice(1,2)]", "9" * 5000]
)
@pytest.mark.parametrize("key", ["task", "num_envs", "learner.name", "network.encoder"])
def test_functions_are_no_values(key, value):
    assert refusal(f"{key}={value}").startswith("override: must be key=value")


def test_quoted_texts_are_texts():
    assert configs.compose(['task="pursuit"'])["task"]["name"] == "pursuit"
    assert overrides.combinations(["task=\"pursuit\",'rendezvous'"]) == [
        [("task", "pursuit")],
        [("task", "rendezvous")],
    ]


def test_a_sweep_has_a_bounded_number_of_runs():
    values = ",".join(map(str, range(40)))
    with pytest.raises(ConfigError, match="sweep: must have at most 1000 combinations of values, got 1600"):
        overrides.combinations([f"seed={values}", f"num_envs={values}"])


def test_long_values_are_shortened_in_messages():
    assert len(schema.shown("a" * 10_000)) < 250
    assert schema.shown(10**5000) == "a number of about 5000 digits"


@pytest.mark.parametrize("key", sorted({*renamed.OF_OTHER_LIBRARIES.values()}))
def test_names_of_other_libraries_stand_for_keys(key):
    config = configs.compose()
    assert key in {*configs.flat(config), *configs.choices()}


def test_no_name_of_another_library_is_a_key_of_ours():
    chosen = [f"{group}={choice}" for group, choices in configs.choices().items() for choice in choices]
    names = {key.rpartition(".")[2] for choice in chosen for key in configs.flat(configs.compose([choice]))}
    assert not names & renamed.OF_OTHER_LIBRARIES.keys()


@pytest.mark.parametrize(
    ("registry", "name", "message"),
    [
        (jaxswarm.AGGREGATORS, "attention", "aggregator: must be one of mean, .*did you mean 'attentive'"),
        (jaxswarm.TASKS, "rendevous", "task: must be one of rendezvous, .*did you mean 'rendezvous'"),
        (jaxswarm.LEARNERS, 3, "learner: must be one of ppo, trl, got 3"),
    ],
)
def test_registries_list_their_names(registry, name, message):
    with pytest.raises(KeyError, match=message):
        registry[name]
    assert name not in registry
    assert registry.get(name) is None


@pytest.mark.parametrize("name", configs.choices()["task"])
def test_every_preset_of_a_task_is_made(name):
    assert jaxswarm.make(name) == configs.build_part("task", configs.compose([f"task={name}"]))


def test_presets_are_made_with_other_fields():
    task = jaxswarm.make("pursuit_multi", num_agents=7)
    assert (task.num_agents, task.num_evaders, task.reward) == (7, 5, "catches")
    with pytest.raises(ConfigError, match=r"task: must be one of .*pursuit_multi, got 'pursuit_many'"):
        jaxswarm.make("pursuit_many")


@pytest.mark.parametrize("key", [0, np.array([1.0, 2.0])])
def test_the_first_state_needs_a_key(key):
    with pytest.raises(TypeError, match=r"key: must be a PRNG key such as jax.random.key\(0\), got"):
        jaxswarm.init(jaxswarm.experiment(), key)
