"""Plays a tape: the world and the agents say again what they said; all others are live."""
