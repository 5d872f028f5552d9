"""Adapters that give tasks the interfaces of other libraries."""

from jaxswarm.bridges.gymnax import Gymnax

__all__ = ["Gymnax"]
