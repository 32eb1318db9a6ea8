"""Limits on what files, packets and plug-ins may hold, each with its reason."""

# Link traces and profiles
MAX_TRACE_FILE_BYTES = 64 << 20  # is read whole
MAX_STEPS = 200_000  # of a trace: it travels to every process in the setup
MIN_STEP_US = 1_000
MAX_PERIOD_US = 86_400_000_000  # a day
MAX_RATE_BPS = 100_000_000_000
MIN_MEAN_BPS = 1_000  # less, and a scan would take hours
MAX_RTT_US = 60_000_000
MAX_LOST_SHARE = 0.3  # of packets; with more, timeouts double faster than anything arrives
MAX_BURST = 50  # packets lost in a row, on average: longer ones are outages

# Point clouds
MAX_CLOUD_FILE_BYTES = 1 << 30  # is read whole
MAX_RECORD_BYTES = 1 << 12  # of a point in a .pcd: a header may name any number of fields

# Scans
MAX_COLUMNS = 8192  # rays of a laser in a revolution
MAX_CHUNKS = 64  # of a scan, as `protocol.messages.Scan` has it

# The edge's plans
MAX_AGE_FRAMES = 10  # an older plan no longer fits the scene
MAX_AHEAD_FRAMES = 64  # a plan for later than this is an error

# Nets
MAX_TERRAIN_NODES = 4_000_000  # 8 km by 8 km; a larger map gets larger cells
MAX_ROAD_CELLS = 1_000_000  # of the lanes' index, 16 km by 16 km; on a larger map they grow too
