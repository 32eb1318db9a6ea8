"""What was heard on both buses, kept as MCAP files that survive a kill, and read back."""
