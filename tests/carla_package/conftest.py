"""The example package's modules, as if it were installed; its entry points are not."""

import sys

from tests.example_plugins import EXAMPLES

sys.path.append(str(EXAMPLES / "carla_package"))
