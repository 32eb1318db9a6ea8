"""Limits on received messages and files, each with its reason."""

from protocol.limits import MAX_BODY_BYTES

# The frame aggregator
MAX_OPEN_FRAMES = 256  # before the newest tick that are still changed: 25 s at 10 Hz
MAX_ENTRIES = 8192  # of a frame: spans, uploads, arrivals; 512 agents with a dozen each fit
MAX_ALL_ENTRIES = 1 << 20  # of all open frames: memory
MAX_WIRED = 1024  # agents of a frame whose bytes on the wire are noted: more than a junction has
MAX_END_TO_END_NS = 60_000_000_000  # of a frame: what is later acts on nothing

# The record role
MAX_PROGRESS_AGENTS = 1024  # with a rate in a progress message: its header is bounded
MAX_PROGRESS_JUNCTIONS = 512  # likewise
MAX_TOTAL_DROPS = (1 << 53) - 1  # what a progress message takes
MAX_PROCESSES = 512  # whose clocks and drops are kept: without keys any process may invent ids
MAX_REASONS = 64  # for which a process drops messages: a process names them itself

# The database
MAX_PENDING_ROWS = 50_000  # before they are written at once: memory
MAX_PENDING_BYTES = 64 << 20  # of scans among them

# MCAP files
MAX_CHUNK_BYTES = 2 * MAX_BODY_BYTES  # a chunk that is nearly full takes one more message
MAX_RECORD_BYTES = 4 * MAX_BODY_BYTES  # a chunk that does not compress fits
MAX_CHANNELS = 16_384  # of a file: a quarter of what the format allows
MAX_CHUNKS = 10_000  # of a file: the index of each stays in memory until the end

# Imported scans
MAX_POSE_FILE_BYTES = 64 << 20  # is read whole
MAX_MOUNT_HEIGHT_M = 100.0  # of a sensor over the ground: more is a mistake of units
