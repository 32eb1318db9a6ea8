"""Viewers of a running system, which publish nothing: Rerun and the terminal.

live       attaches to a run and draws at a frame rate
scene      a frame as a picture: messages, clouds, figures
layers     boxes, truth, lamps, counts, cells as arrays
road       the road's surface, markings and places of counts
stages     upload rates and latency by stage, over time
rerun_log  draws with Rerun, and lays out the screen
sinks      a window, a page or a file for Rerun
board      rows of the terminal view
terminal   draws them
"""
