"""Search for good settings with Optuna, by any number of processes that share a storage.

Each trial is a run folder, trained over several seeds side by side. Its value is the mean of all evaluation returns
during training, over seeds: what the thesis maximized, which rewards good results and getting there soon.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxswarm import config as configs
from jaxswarm.config import Config, ConfigError
from jaxswarm.files import RETURN, Row
from jaxswarm.learners.on_policy import nearest_batch_sizes

if TYPE_CHECKING:
    import optuna

BATCH_SIZE = "learner.batch_size"
REQUEUED = "requeued"  # a trial that was cut off, and will be continued as another one
RUN_DIR = "run_dir"

Space = dict[str, Any]  # what may be chosen for each key


def load_space(name: str, config: Config) -> Space:
    """The space of a file in `configs/search`, or at a path, for the aggregator of the config."""
    shipped = {path.stem: path for path in (configs.config_dir() / configs.SEARCHES).glob("*.yaml")}
    path = shipped.get(name, Path(name))
    if not path.is_file():
        raise ConfigError(f"search: must be one of {', '.join(sorted(shipped))}, or a YAML file, got {name!r}")
    content = configs.read(path)
    if unknown := set(content) - {"parameters", "aggregator"}:
        raise ConfigError(f"{path}: keys must be parameters and aggregator, got {unknown.pop()!r}")
    parameters, of_aggregators = (content.get(part) or {} for part in ("parameters", "aggregator"))
    if not all(isinstance(x, dict) for x in (parameters, of_aggregators, *getattr(of_aggregators, "values", list)())):
        raise ConfigError(f"{path}: must have the form parameters: {{key: choice}}, aggregator: {{name: {{...}}}}")
    space = parameters | of_aggregators.get(config["aggregator"]["name"], {})
    for key, choice in space.items():
        _check(key, choice)
    return space


def open_study(storage: str, name: str = "jaxswarm") -> "optuna.Study":
    """The study in a storage: a database's URL, or the path of a journal file that machines may share."""
    try:
        import optuna  # noqa: PLC0415
        from optuna.storages.journal import JournalFileBackend  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError('search needs a package: pip install "jaxswarm[search]"') from error

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        where = storage if "://" in storage else optuna.storages.JournalStorage(JournalFileBackend(storage))
        return optuna.create_study(storage=where, study_name=name, direction="maximize", load_if_exists=True)
    except Exception as error:
        raise ConfigError(f"storage = {storage} cannot be opened: {' '.join(str(error).split())[:200]}") from error


def ask(study: "optuna.Study", seed: int) -> "optuna.Trial":
    """The next trial. Its number, which no other process gets, tells what is drawn for it."""
    import optuna  # noqa: PLC0415

    trial = study.ask()
    study.sampler = optuna.samplers.TPESampler(seed=(seed + trial.number) % 2**32)
    return trial


def num_started(study: "optuna.Study") -> int:
    """Trials that were begun, by any process, and were not cut off."""
    trials = study.get_trials(deepcopy=False)
    return sum(trial.state.name != "WAITING" and REQUEUED not in trial.user_attrs for trial in trials)


def requeue(study: "optuna.Study", trial_number: int) -> None:
    """Lets a trial that was cut off be continued by whoever comes next."""
    trial = study.get_trials(deepcopy=False)[trial_number]
    study.enqueue_trial(trial.params, user_attrs={RUN_DIR: trial.user_attrs[RUN_DIR]})
    study._storage.set_trial_user_attr(trial._trial_id, REQUEUED, True)
    study.tell(trial_number, state=_state("FAIL"))


def requeue_killed(study: "optuna.Study", sweep_dir: Path) -> None:
    """`requeue` for trials in this folder that a process left when it was killed; nobody else may work there."""
    for trial in study.get_trials(deepcopy=False):
        run_dir = trial.user_attrs.get(RUN_DIR)
        if trial.state.name == "RUNNING" and run_dir and Path(run_dir).parent == sweep_dir.resolve():
            requeue(study, trial.number)


def suggest(trial: "optuna.Trial", space: Space, pairs: Sequence[tuple[str, Any]]) -> Config:
    """The config of a trial; `pairs` are what the command line says, and win."""
    composed, groups = configs.compose_pairs(pairs), configs.choices()
    given = {configs.full_key(key, composed) for key, _ in pairs if key not in groups}
    chosen = [(key, _suggest(trial, key, choice)) for key, choice in space.items() if key not in given]
    config = configs.compose_pairs([*pairs, *[(key, value) for key, value in chosen if key != BATCH_SIZE]])
    wanted = dict(chosen).get(BATCH_SIZE)
    if wanted is None:
        return config
    experiment = configs.build(configs.override(config, [(BATCH_SIZE, None)]))
    learner = experiment.learner.replace(batch_size=wanted)
    sizes = nearest_batch_sizes(learner, experiment.agent_steps_per_update, experiment.task.num_agents)
    return configs.override(config, [(BATCH_SIZE, sizes[0])])


def value(rows: Sequence[Row], seeds: Sequence[int], num_evaluations: int) -> float:
    """Mean over as many evaluations of all seeds; NaN without any. A seed that diverged has its worst from there on."""
    if not rows:
        return math.nan
    worst = min(row[RETURN] for row in rows)
    returns = []
    for seed in seeds:
        mine = [row[RETURN] for row in rows if row["seed"] == seed]
        returns += mine + [min(mine, default=worst)] * (num_evaluations - len(mine))
    return float(np.mean(returns))


def tell(study: "optuna.Study", trial: "optuna.Trial", found: float) -> None:
    """Ends a trial; one without a finite value has failed."""
    if math.isfinite(found):
        study.tell(trial, found)
    else:
        study.tell(trial, state=_state("FAIL"))


def _state(name: str) -> "optuna.trial.TrialState":
    from optuna.trial import TrialState  # noqa: PLC0415

    return TrialState[name]


def _suggest(trial: "optuna.Trial", key: str, choice: Any) -> Any:
    if isinstance(choice, list):
        return trial.suggest_categorical(key, choice)
    if "layers" in choice:
        least, most = choice["layers"]
        count = trial.suggest_int(f"{key}.layers", least, most)
        widths = [_suggest(trial, f"{key}.{i}", {k: choice[k] for k in ("low", "high")}) for i in range(count)]
        return [*widths, _suggest(trial, f"{key}.last", choice["last"])] if "last" in choice else widths
    low, high = choice["low"], choice["high"]
    options = {name: choice[name] for name in ("log", "step") if name in choice}
    is_integer = isinstance(low, int) and isinstance(high, int)
    return (trial.suggest_int if is_integer else trial.suggest_float)(key, low, high, **options)


def _check(key: str, choice: Any) -> None:
    """Raises a `ConfigError` for what is not a choice."""
    if not ((isinstance(choice, list) and choice) or _is_range(choice, {"log", "step", "layers", "last"})):
        accepted = "a list, or numbers low and high and if wanted log (from above 0), step, layers: [least, most], last"
        raise ConfigError(f"{key}: must be {accepted}, got {choice}")


def _is_range(choice: Any, more: set[str]) -> bool:
    """Whether it has numbers low <= high, and of `more` nothing that cannot be."""

    def is_number(x: Any) -> bool:
        return isinstance(x, int | float) and not isinstance(x, bool)

    if not isinstance(choice, Mapping) or not {"low", "high"} <= choice.keys() <= {"low", "high", *more}:
        return False
    low, high, step, layers = choice["low"], choice["high"], choice.get("step"), choice.get("layers")
    if not is_number(low) or not is_number(high) or low > high or (choice.get("log") and low <= 0):
        return False
    is_pair = isinstance(layers, list) and len(layers) == 2 and all(isinstance(x, int) and x >= 0 for x in layers)
    return (
        (step is None or (is_number(step) and step > 0 and not choice.get("log")))
        and (layers is None or (is_pair and layers[0] <= layers[1]))
        and ("last" not in choice or (layers is not None and _is_range(choice["last"], {"log", "step"})))
    )
