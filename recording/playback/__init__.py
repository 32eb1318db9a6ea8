"""Playback of a recording: world and agents publish recorded messages, others are live.

frames  the recording frame by frame; an agent's messages in a frame, and its upload
role    the player role, instead of one process of agents
world   the recorded world, instead of SUMO
"""
