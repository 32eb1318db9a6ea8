"""Runs the world or the agents of a replay as a process, by its id."""

from protocol.process import WORLD_ID, Context, Role, run
from recording.playback.role import PlayerRole
from recording.playback.world import sim_role


def role_of(context: Context) -> Role:
    """Returns the role that this process plays."""
    return sim_role(context) if context.id == WORLD_ID else PlayerRole.build(context)


if __name__ == "__main__":
    run("player", role_of)
