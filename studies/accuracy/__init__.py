"""How well vehicles are found at single samples: Table 1 of Chen et al. 2022, and its pictures."""
