"""A shaping relay in the path of agents' V2X connections: emulated links, without root."""
