"""`python -m cpnet`, and the installed command."""

import sys


def main() -> None:
    """Runs the command; Ctrl-C while Python still reads it in ends it without a traceback."""
    try:
        from cpnet.cli import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
