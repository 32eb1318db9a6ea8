"""Runs the vehicle role as a process."""

from protocol.process import run
from vehicle_agent.role import VehicleRole

if __name__ == "__main__":
    run("vehicle", VehicleRole)
