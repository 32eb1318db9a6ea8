"""Pages about studies: what came of all cells, as tables and charts."""
