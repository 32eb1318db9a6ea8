"""`python -m edge_server`: see `protocol.process`."""

from edge_server.role import EdgeRole
from protocol.process import run

run("edge", EdgeRole.build)
