"""Looking on: what a running system says of itself, as pictures and figures. Nothing is said."""
