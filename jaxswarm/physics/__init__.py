"""Physics of the tasks: motion of agents, rigid-body collisions, and neighbor search."""
