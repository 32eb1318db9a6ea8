"""MCAP recordings of both buses, which survive SIGKILL.

    format             names of files and metadata, schemas of messages
    writer, reader     native messages, as they were published
    recorder           the mcap role, and `cpnet record`
    foxglove           conversion for Foxglove and other tools
    foxglove_messages  Foxglove's messages

Importing it raises ConfigError where the extra `mcap` is not installed.
"""

from importlib.util import find_spec

from protocol.errors import ConfigError
from protocol.extras import to_install

if missing := [
    name for name in ("mcap", "mcap_protobuf", "foxglove_schemas_protobuf") if not find_spec(name)
]:
    raise ConfigError(f"MCAP recordings need {', '.join(missing)}: {to_install('mcap')}")
