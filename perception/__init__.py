"""What finds vehicles in points: pure stages, for whoever holds points, an edge or an agent."""
