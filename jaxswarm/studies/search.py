"""Search for good settings with Optuna. Any number of processes can share a storage.

Each trial is a run folder with several seeds, which are vectorized. The value of a trial is the mean of all evaluation
returns during training, over all seeds. The thesis maximized the same value, which rewards good and fast learning.
"""

import json
import math
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxswarm import config as configs
from jaxswarm.config import Config, ConfigError, renamed
from jaxswarm.files import RETURN, Row
from jaxswarm.learners.on_policy import nearest_batch_sizes

if TYPE_CHECKING:
    import optuna

BATCH_SIZE = "learner.batch_size"
RESUMES = "resumes"  # attribute of a trial that resumes an interrupted one: the number of that trial
REQUEUED = "requeued"  # attribute that version 0.1 gave interrupted trials instead
RUN_DIR = "run_dir"  # attribute of a trial: its run folder

WRITE_SECONDS = 0.5  # longer than the writing of a line of a journal

Space = dict[str, Any]  # the choice for each key: a list of values or a range


def load_space(name: str, config: Config) -> Space:
    """Load the search space of a file in `configs/search`, or at a path, for the aggregator of the config.

    A file has `parameters: {key: choice}`, and `aggregator: {name: {key: choice}}` for choices that are added, or
    replace others, for one aggregator. A choice is a list of values, or a range `{low: 1, high: 9}`, of integers if
    both are integers, on a logarithmic scale with `log: true`; `step: 12` takes every twelfth number from `low`.
    `layers: [least, most]` makes it a list of that many widths from the range, and `last` is the range of the last one.

    Raises a `ConfigError` for an unknown name or an invalid file.
    """
    shipped = {path.stem: path for path in (configs.config_dir() / configs.SEARCHES).glob("*.yaml")}
    path = shipped.get(name, Path(name))
    if not path.is_file():
        raise ConfigError(f"search: must be one of {', '.join(sorted(shipped))}, or a YAML file, got {name!r}")
    content = configs.read(path)
    if unknown := set(content) - {"description", "parameters", "aggregator"}:
        raise ConfigError(f"{path}: keys must be parameters and aggregator, got {unknown.pop()!r}")
    parameters, of_aggregators = (content.get(part) or {} for part in ("parameters", "aggregator"))
    if not all(isinstance(x, dict) for x in (parameters, of_aggregators, *getattr(of_aggregators, "values", list)())):
        raise ConfigError(f"{path}: must have the form parameters: {{key: choice}}, aggregator: {{name: {{...}}}}")
    space = parameters | of_aggregators.get(config["aggregator"]["name"], {})
    space, changes = renamed.translate_space(space, configs.flat(config).__contains__)
    if changes:
        print(f"{path} was written for jaxswarm 0.1; its keys were translated: {', '.join(changes)}", file=sys.stderr)
    for key, choice in space.items():
        _check(key, choice)
    return space


def open_study(storage: str, name: str = "jaxswarm") -> "optuna.Study":
    """Open or create the study in a storage: the URL of a database, or the path of a journal file.

    Machines can share either. Raises a `ConfigError` if Optuna is missing or the storage cannot be opened.
    """
    try:
        import optuna  # noqa: PLC0415
        from optuna.storages.journal import JournalFileBackend  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError('search needs Optuna; install it with: pip install "jaxswarm[search]"') from error

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    if "://" not in storage:
        _check_journal(Path(storage))
    try:
        opened = storage if "://" in storage else optuna.storages.JournalStorage(JournalFileBackend(storage))
        return optuna.create_study(storage=opened, study_name=name, direction="maximize", load_if_exists=True)
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"storage: must be a database URL or a journal file, got {storage!r} ({reason})") from error


def _check_journal(path: Path) -> None:
    """Raise a `ConfigError` for a line that a killed process has left incomplete, because Optuna cannot read it."""
    number = _invalid_line(path)
    if number is not None:
        time.sleep(WRITE_SECONDS)  # another process may be writing this line
        number = _invalid_line(path)
    if number is not None:
        repair = f"sed -i {number}d {shlex.quote(str(path))}"
        cause = "a process was killed while it wrote this line"
        raise ConfigError(
            f"storage: line {number} of {path} must be complete JSON; {cause}. "
            f"Stop all processes of the search, and remove the line with: {repair}"
        )


def _invalid_line(path: Path) -> int | None:
    """Return the number of the first incomplete line of a journal, counted from 1; `None` if there is none."""
    lines = path.read_bytes().splitlines(keepends=True) if path.is_file() else []
    for number, line in enumerate(lines, 1):
        try:
            is_valid = line.endswith(b"\n") and isinstance(json.loads(line), dict)
        except ValueError:
            is_valid = False
        if not is_valid:
            return number
    return None


def ask(study: "optuna.Study", seed: int) -> "optuna.Trial":
    """Return the next trial. Its number is unique among all processes and seeds the sampler of its settings."""
    import optuna  # noqa: PLC0415

    trial = study.ask()
    study.sampler = optuna.samplers.TPESampler(seed=(seed + trial.number) % 2**32)
    return trial


def num_started(study: "optuna.Study") -> int:
    """Return the number of trials that any process has started. Interrupted trials do not count."""
    trials = study.get_trials(deepcopy=False)
    interrupted = _interrupted(trials)
    return sum(trial.state.name != "WAITING" and trial.number not in interrupted for trial in trials)


def requeue(study: "optuna.Study", trial_number: int) -> None:
    """Enqueue an interrupted trial again; the next process that asks for a trial resumes it in the same run folder."""
    trials = study.get_trials(deepcopy=False)
    trial = trials[trial_number]
    if trial_number not in _interrupted(trials):
        study.enqueue_trial(trial.params, user_attrs={RUN_DIR: trial.user_attrs[RUN_DIR], RESUMES: trial_number})
    study.tell(trial_number, state=_state("FAIL"))


def requeue_killed(study: "optuna.Study", sweep_dir: Path) -> None:
    """Requeue the trials in this folder whose process was killed. No other process may use the folder."""
    for trial in study.get_trials(deepcopy=False):
        run_dir = trial.user_attrs.get(RUN_DIR)
        if trial.state.name == "RUNNING" and run_dir and Path(run_dir).parent == sweep_dir.resolve():
            requeue(study, trial.number)


def suggest(trial: "optuna.Trial", space: Space, pairs: Sequence[tuple[str, Any]]) -> Config:
    """Return the config of a trial. `pairs` are the overrides of the command line, which take precedence."""
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
    """Return the mean over `num_evaluations` evaluations of each seed; NaN without any.

    The missing evaluations of a seed that diverged count as its worst one, or as the worst of all seeds if it has none.
    """
    if not rows:
        return math.nan
    worst = min(row[RETURN] for row in rows)
    returns = []
    for seed in seeds:
        of_seed = [row[RETURN] for row in rows if row["seed"] == seed]
        returns += of_seed + [min(of_seed, default=worst)] * (num_evaluations - len(of_seed))
    return float(np.mean(returns))


def tell(study: "optuna.Study", trial: "optuna.Trial", found: float) -> None:
    """Finish a trial with its value; a trial without a finite value has failed."""
    if math.isfinite(found):
        study.tell(trial, found)
    else:
        study.tell(trial, state=_state("FAIL"))


def _interrupted(trials: "Sequence[optuna.trial.FrozenTrial]") -> set[int]:
    """Return the numbers of the trials that other trials resume."""
    resumed = {trial.user_attrs[RESUMES] for trial in trials if RESUMES in trial.user_attrs}
    return resumed | {trial.number for trial in trials if REQUEUED in trial.user_attrs}


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
    """Raise a `ConfigError` if the choice is neither a list nor a valid range."""
    if not ((isinstance(choice, list) and choice) or _is_range(choice, {"log", "step", "layers", "last"})):
        accepted = "a list, or numbers low <= high, with optional keys log (low > 0), step, layers: [min, max], last"
        raise ConfigError(f"{key}: must be {accepted}, got {choice}")


def _is_range(choice: Any, more: set[str]) -> bool:
    """Return whether a choice has numbers low <= high, and of the optional keys `more` only valid ones."""

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
