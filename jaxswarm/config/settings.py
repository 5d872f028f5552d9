"""Settings of a run beyond its experiment."""

import dataclasses
import math
from typing import Literal

from jaxswarm.config.schema import ConfigError, is_number, shown
from jaxswarm.limits import LARGER_INTEGERS, MAX_INTEGER, MAX_NUMBER

LENGTHS = ("num_updates", "total_agent_steps")  # two units for the length of a run
LEAST = {"seed": 0, "checkpoint_seconds": 0}  # of the numbers that may be less than 1
MOST = {"num_seeds": 2**16, "checkpoint_seconds": MAX_NUMBER, **LARGER_INTEGERS}  # of those not below 2**31


@dataclasses.dataclass(frozen=True)
class RunSettings:
    """Settings of a run beyond its experiment: seeds, length, checkpoints, outputs, warm start and imports.

    In Python, `null` is `None`. Raises a `ConfigError` for impossible values.

    Attributes:
        seed: All random numbers of the run are derived from this seed.
        num_seeds: This number of seeds, counted up from `seed`, is trained in one program.
        num_updates: The run has this number of updates; either this or total_agent_steps is null.
        total_agent_steps: The run has this number of agent steps (environment steps times agents), rounded up to whole
            updates; either this or num_updates is null.
        checkpoint_seconds: Checkpoints are saved at most once in this number of seconds.
        keep_checkpoints: This number of latest checkpoints is kept, in addition to the best one.
        render_every: A replay page is written every time this number of evaluations is done; with null, it is written
            once, at the end.
        loggers: Metrics are also sent to these loggers: tensorboard, wandb.
        init_from: Training starts from the best policy of this run folder (warm start); the task may differ in
            numbers, for example in the number of agents.
        imports: These Python files or modules are imported to register your own tasks, aggregators or learners.
    """

    seed: int = 0
    num_seeds: int = 1
    num_updates: int | None = None
    total_agent_steps: int | None = None
    checkpoint_seconds: float = 30.0
    keep_checkpoints: int = 3
    render_every: int | None = None
    loggers: tuple[Literal["tensorboard", "wandb"], ...] = ()
    init_from: str | None = None
    imports: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if (self.num_updates is None) == (self.total_agent_steps is None):
            given = f"{self.num_updates} and {self.total_agent_steps}"
            raise ConfigError(f"num_updates and total_agent_steps: exactly one must be set, got {given}")
        for field in dataclasses.fields(self):
            name, value = field.name, getattr(self, field.name)
            least, most = LEAST.get(name, 1), MOST.get(name, MAX_INTEGER)
            if is_number(value) and not least <= value <= most:
                raise ConfigError(f"{name}: must be a number from {least} to {most:.16g}, got {shown(value)}")
        if self.seed + self.num_seeds > 2**32:
            raise ConfigError(f"seed: seed + num_seeds must be at most 2**32, got {self.seed} + {self.num_seeds}")

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds that are trained in one program."""
        return tuple(range(self.seed, self.seed + self.num_seeds))

    def length(self, agent_steps_per_update: int) -> int:
        """Return the number of updates. `total_agent_steps` is rounded up to whole updates.

        Raises a `ConfigError` for more updates than a 32-bit counter can hold.
        """
        if self.num_updates is not None:
            return self.num_updates
        assert self.total_agent_steps is not None
        most = MAX_INTEGER * agent_steps_per_update
        if self.total_agent_steps > most:
            accepted = f"at most {most}, which is {MAX_INTEGER} updates of {agent_steps_per_update} agent steps"
            raise ConfigError(f"total_agent_steps: must be {accepted}, got {self.total_agent_steps}")
        return math.ceil(self.total_agent_steps / agent_steps_per_update)
