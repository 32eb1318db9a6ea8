"""A LiDAR on a post at the roadside."""
