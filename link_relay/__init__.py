"""Relays between agents and the edge that emulate links in realtime.

`shaper`: the TCP relay with a link's rate and delay. `role`: the process around it.
"""
