"""Limits of all numbers that users give, beyond the range of a single field."""

MAX_INTEGER = 2**31 - 1  # of sizes and counters, which are 32-bit integers on devices
MAX_NUMBER = 1e12  # of the magnitude of numbers, whose squares and cubes must stay finite in single precision
MAX_LENGTH = 64  # of lists, such as the layers of a network
LARGER_INTEGERS = {"seed": 2**32 - 1, "total_agent_steps": 2**53}  # of keys that the host counts
MAX_WIDTH = 2**16  # of the layers of a network
MAX_ENTITIES = 10**6  # of the agents of a swarm, and of the entities that they perceive
