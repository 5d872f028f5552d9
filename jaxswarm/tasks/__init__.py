"""Registry of tasks: `TASKS` maps the name of a task to its class."""

from jaxswarm.registry import Registry
from jaxswarm.tasks.boxes import Assembly, Clustering
from jaxswarm.tasks.pursuit import Pursuit
from jaxswarm.tasks.rendezvous import Rendezvous

TASKS = Registry("task", {"rendezvous": Rendezvous, "pursuit": Pursuit, "assembly": Assembly, "clustering": Clustering})
