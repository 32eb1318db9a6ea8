"""What recorded runs say: figures of merit, summaries, pictures."""
