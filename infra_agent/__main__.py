"""Runs the infra role as a process."""

from infra_agent.role import InfraRole
from protocol.process import run

if __name__ == "__main__":
    run("infra", InfraRole)
