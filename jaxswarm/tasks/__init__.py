"""The tasks, by name."""

from jaxswarm.tasks.rendezvous import Rendezvous

TASKS = {"rendezvous": Rendezvous}
