"""Limits on nets, polygon files, processes and requests, each with its reason."""

MAX_ID_CHARS = 512  # of a lane, edge or junction in a net
MAX_NAME_CHARS = 118  # of a flow, and a number behind it: a message takes 128
MAX_HEIGHT_M = 1000.0  # of a building in a polygon file
MAX_PROCESSES = 256  # of the role vehicle that get vehicles to play
MAX_PENDING_REQUESTS = 512  # the longest deadline, 10 s, at 0.1 s a frame, has 100
MAX_PENDING_ADVICE = 1 << 15  # as long, of some hundred vehicles at a time
