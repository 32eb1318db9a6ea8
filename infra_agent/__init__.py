"""The roadside unit: a LiDAR on a mast. All in `role`."""
