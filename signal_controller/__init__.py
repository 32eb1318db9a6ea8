"""The signal controller: lane counts in, the wish for a phase out. Policies are pure functions."""
