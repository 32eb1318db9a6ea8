"""Limits on data received by the command line's processes, each with its reason."""

MAX_UNEXPECTED = 256  # unexpected processes: without keys any process may announce itself
MAX_BATCH = 256  # messages taken at once: a flood must not keep the supervisor from its processes
MAX_WAITING_METRICS = 64  # messages of each process, until the supervisor takes them
# Values of a label on the metrics page: each costs a time series for as long as the run lasts.
MAX_PROCESSES = 256
MAX_REASONS = 64
MAX_STAGES = 32
MAX_REGIONS = 128
MAX_SIGNALS = 512
