"""`python -m edge_server`: see `protocol.process`."""

from edge_server.role import EdgeRole, keep_freed_memory
from protocol.process import run

keep_freed_memory()
run("edge", EdgeRole.build)
