"""Links between agents and the edge: profiles, and what they do to bytes."""
