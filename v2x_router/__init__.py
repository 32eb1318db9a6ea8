"""The V2X router: a process that only hosts the V2X bus, so that an edge's end stops no other."""
