"""The tasks, by name."""

from jaxswarm.tasks.boxes import Assembly, Clustering
from jaxswarm.tasks.rendezvous import Rendezvous

TASKS = {"rendezvous": Rendezvous, "assembly": Assembly, "clustering": Clustering}
