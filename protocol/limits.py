"""Limits on received data: messages, keys and scans from a bus.

Each with its reason. Any process that can reach a bus can send anything to it. Sizes are checked
against these numbers before anything is allocated. The other packages with input of their own have
such a table as well.
"""

# A message
MAX_BODY_BYTES = 16 << 20  # the largest scan and the largest setup fit, with room
MAX_HEADER_BYTES = 256 << 10  # 512 agents with their scores fit
MAX_SETUP_HEADER_BYTES = 16 << 20  # two recorded link traces take 9 MiB
MAX_WORLD_HEADER_BYTES = 8 << 20  # ids, types and lanes of the bodies of a city
MAX_CONTAINERS = 1 << 13  # lists and maps of a header, plus one for every 16 bytes: memory
MAX_ITEMS = 4096  # of a list or map: more than a junction holds
MAX_BODIES = 1 << 16  # of a city at one time
MAX_TILE = 1 << 20  # column or row: beyond what MAX_POSITION_M allows
MAX_KEY_CHARS = 8 << 10  # more than the longest ids take, percent-encoded

# Fields
MAX_ID_CHARS = 128  # of a process, an agent, a role: stands in keys, file names, tables
MAX_AGENT_ID_BYTES = 128  # many agents must fit into one message
MAX_TEXT_CHARS = 512  # joined junctions have long ids; a signal's state has a letter per link
MAX_POSITION_M = 1e7  # farther than any map
MAX_ANGLE_RAD = 1e3  # sin and cos stay exact
MAX_LENGTH_M = 60.0  # of a vehicle: longer than any road train
MAX_WIDTH_M = 10.0
MAX_HEIGHT_M = 10.0
MAX_POSITION_STD_M = 1000.0  # worse than no position
MAX_SPEED_MPS = 200.0  # of a vehicle: faster than any, and than the error of any track's speed
MAX_COASTED_S = 86_400.0  # since a track was last observed: a day, longer than any is kept
MAX_TRACK_ID = 1 << 62  # a region, a frame and a number fit
MAX_CHUNKS = 64  # of a scan: each costs the edge a message and a decoding
MAX_MBPS = 1e6  # of an uplink: a terabit
MAX_COUNT = 1 << 40  # frame numbers and counts: sums stay within 64 bit
MAX_TOTAL = 1 << 53  # sums over a run: exact as float64
MAX_TIME_NS = 1 << 62  # differences fit into 64 bit
MAX_DELAY_NS = 60_000_000_000  # a minute: a result that is later acts on nothing
MAX_OFFSET_NS = 1 << 61  # between two clocks: 73 years
MAX_FRAMES_AHEAD = 64  # beyond the newest real frame: 6 s at 10 Hz

# A scan
MAX_BEAMS = 1 << 19  # 128 rings of 4096 columns
MAX_POINTS = 1 << 20  # two returns of each beam
MAX_KEPT_BEAMS = 1 << 18  # of a pattern whose directions are cached
MAX_KEPT_PATTERNS = 16  # of that size they take 120 MB
MIN_STEP_M, MAX_STEP_M = 1e-6, 40.0  # of quantisation: bounds from 0.1 mm to 10 m, with room
MAX_TREE_DEPTH = 20  # three bits a level fit into a key of 64
MAX_TREE_ORIGIN_M = 1e9  # float32 coordinates stay finite
MAX_TABLES = 255  # of a stream of symbols: a byte numbers them, and each takes 4 KiB
MAX_CELL_EDGE_M = 100.0  # of the octree beside a ring image
MAX_BEAM_HEIGHT_M, MAX_BEAM_RADIUS_M = 1.0, 0.5  # where a ring image's beams begin
FREE_TREE_SYMBOLS = 1 << 20  # a symbol that is certain takes next to no bits, so that a few
TREE_SYMBOLS_PER_WORD = 128  # bytes could hold millions of them

# The inbox
MAX_INBOX_ITEMS = 16_384
MAX_INBOX_BYTES = 256 << 20  # sixteen of the largest messages, or 8000 scans
MAX_SENDERS = 128  # with a quota of their own
QUOTA_OF_FREE = 0.5  # a sender's share of the places and bytes that are free
EXTRA_QUOTAS = 2  # of the rate: for all unknown senders, for messages whose key has no process
MAX_MESSAGES_PER_S = 8000.0  # of all senders: what a role reads without being late
MIN_QUOTA_PER_S = 1000.0  # of one sender: what a process with twenty agents may send at 10 Hz
BURST_S = 0.5  # so much of its rate may come at once
MAX_DEBT_S = 1.0  # so much of its rate, at most, must be made up for
MAX_BATCH = 256  # messages that a role takes before it acts, so that a flood cannot stop it

# The log
MAX_LOG_LINES = 64  # about bad messages: later ones are only counted
MAX_SHOWN_CHARS = 200  # of a key, a text or a reason from the network
