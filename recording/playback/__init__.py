"""Plays a recording: the world and the agents publish what was recorded, all others are live.

frames  the recording frame by frame; what an agent published in a frame, and its upload
role    the player role, in the place of one process of agents
world   the recorded world, in the place of SUMO
"""
