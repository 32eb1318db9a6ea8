"""Labelled clouds of generated junctions, and what is learned from them."""
