"""One folder a run: what was sent, seen, counted and decided, in one SQLite file."""
