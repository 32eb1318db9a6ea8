"""Imported last by the process that others are forked off, see `cpnet.nursery`, and by no other."""

import atexit
import gc
import os

gc.freeze()  # what was imported stays: no collection of those that are forked off need look at it
atexit.register(os._exit, 0)  # to take it all apart would take longer than who waits has patience
