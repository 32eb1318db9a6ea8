"""PointPillars (Lang et al. 2019): a learned detector, on the CPU or on a GPU."""
