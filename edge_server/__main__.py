"""`python -m edge_server`: see `protocol.process`."""

from edge_server.decoding import keep_freed_memory
from edge_server.role import EdgeRole
from protocol.process import run

keep_freed_memory()
run("edge", EdgeRole.build)
