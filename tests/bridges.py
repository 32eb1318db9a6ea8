"""A net with a bridge: a street with a signal, and over it a road that has a signal of its own."""

from pathlib import Path

from sim_host.junctions import Row, write_plain_net

ACROSS_M = 60.0
"""x at which the upper road passes over the street, which runs along y = 0."""


def write_bridge(folder: Path, high_m: float) -> Path:
    """Writes `bridge.net.xml` into a folder; the upper road lies so high over the street.

    Raises:
        ConfigError: netconvert is missing or fails.
    """
    places = {
        "J": (0, 0),
        "west": (-250, 0),
        "east": (300, 0),
        "north": (0, 200),
        "K": (ACROSS_M, -170),
        "up": (ACROSS_M, 300),
        "south": (ACROSS_M, -350),
        "side": (-140, -170),
    }
    nodes: list[Row] = [
        {
            "id": name,
            "x": x,
            "y": y,
            "z": 0,
            "type": "traffic_light" if name in "JK" else "priority",
        }
        for name, (x, y) in places.items()
    ]
    rise = [(-170, 0), (-130, 0), (-40, high_m), (40, high_m), (130, 0), (300, 0)]
    streets = ("west J", "J east", "J north", "K up", "south K", "side K")
    edges: list[Row] = []
    for start, end in (street.split() for street in streets):
        for a, b, ordered in ((start, end, rise), (end, start, rise[::-1])):
            row: Row = {"id": f"{a}-{b}", "from": a, "to": b, "numLanes": 2, "speed": 13.89}
            if "up" in (a, b):
                row = row | {"shape": " ".join(f"{ACROSS_M:g},{y},{z:g}" for y, z in ordered)}
            edges.append(row)
    return write_plain_net(folder, "bridge", {"node": nodes, "edge": edges})
