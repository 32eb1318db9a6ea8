"""Relays in the path of agents' V2X connections: links that are emulated, with root or without."""
