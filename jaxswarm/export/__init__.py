"""Export of trained policies to files that run without jaxswarm."""

from jaxswarm.export.program import PLATFORMS, export_policy

__all__ = ["PLATFORMS", "export_policy"]
