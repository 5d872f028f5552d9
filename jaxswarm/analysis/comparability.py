"""Choice of the metric that compares runs of a task with different settings.

The scale of a return depends on some settings of the task. A task declares them, with metrics that do not depend on
them, in `comparable_metrics`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jaxswarm.config.groups import registries
from jaxswarm.types import Comparable

RETURN = "return"  # metric of all tasks


class Comparison(NamedTuple):
    """Metric that compares runs, without the prefix `eval/`.

    `settings` are the fields of the task that differ and change the scale of the return.
    """

    metric: str = RETURN
    is_higher_better: bool = True
    settings: tuple[str, ...] = ()

    def better(self, value: float) -> float:
        """Return the value with a sign such that higher is better."""
        return value if self.is_higher_better else -value

    def explain(self) -> str:
        """Return why runs are compared by this metric, or "" if returns are comparable."""
        if not self.settings:
            return ""
        reason = f"the return depends on {', '.join(f'task.{name}' for name in self.settings)}"
        if self.metric == RETURN:
            return f"{reason}, so returns are not comparable; the task declares no metric that does not"
        direction = "higher" if self.is_higher_better else "lower"
        return f"{reason}; {self.metric} ({direction} is better) does not, and is compared instead"


def compare(tasks: Sequence[Mapping[str, Any]]) -> Comparison:
    """Return the metric for runs of these tasks, given as configs: `name` and the fields of the task.

    It is the return if nothing differs that changes its scale. Otherwise it is the first metric of the task that does
    not depend on any of these settings, or the return if there is none.
    """
    candidates = _declared({task.get("name") for task in tasks})
    declared = dict.fromkeys(name for candidate in candidates for name in candidate.settings)
    settings = tuple(name for name in declared if any(task.get(name) != tasks[0].get(name) for task in tasks))
    if not settings:
        return Comparison()
    fitting = [candidate for candidate in candidates if set(settings) <= set(candidate.settings)]
    if not fitting:
        return Comparison(settings=settings)
    return Comparison(fitting[0].metric, fitting[0].is_higher_better, settings)


def _declared(names: set[str | None]) -> tuple[Comparable, ...]:
    """Return the metrics that a task declares; none for several tasks."""
    classes = [registries()["task"].get(name) for name in names if name]
    return getattr(classes[0], "comparable_metrics", ()) if len(names) == len(classes) == 1 else ()
