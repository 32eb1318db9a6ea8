"""What was heard on both buses, kept as MCAP files that survive a kill, and read back.

Importing it raises ConfigError where the extra `tape` is not installed.
"""

from importlib.util import find_spec

from protocol.errors import ConfigError

if missing := [
    name for name in ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf") if not find_spec(name)
]:
    raise ConfigError(f"tapes need {', '.join(missing)}: pip install 'cpnet-edge[tape]'")
