"""`python -m cpnet`."""

from cpnet.cli import main

if __name__ == "__main__":
    main()
