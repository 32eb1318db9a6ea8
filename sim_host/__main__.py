"""The process of the role sim."""

from protocol.process import run
from sim_host.role import SimRole

if __name__ == "__main__":
    run("sim", SimRole.build)
