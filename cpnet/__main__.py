"""`python -m cpnet`, and the installed command."""

import signal
import sys
from types import FrameType

from cpnet.shadowing import check_packages


def main() -> None:
    """Runs the command; a signal to end ends it without a traceback, and cleans up."""
    signal.signal(signal.SIGTERM, _end)
    try:
        check_packages()
    except ImportError as error:
        sys.stderr.write(f"error {error}\n")
        sys.exit(2)
    try:
        from cpnet.cli import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(130)


def _end(number: int, _: FrameType | None) -> None:
    sys.exit(128 + number)


if __name__ == "__main__":
    main()
