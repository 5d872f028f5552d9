"""How bodies move, collide and find each other: the physics below the tasks."""
