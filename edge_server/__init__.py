"""The edge server: scans and poses in, vehicles and counts per lane out. Knows the V2X bus only."""
