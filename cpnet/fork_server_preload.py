"""The last module that the fork server imports, see `cpnet.fork_server`; no other process does."""

import atexit
import gc
import os

gc.freeze()  # what was imported stays: no collection of those that are forked off need look at it
atexit.register(os._exit, 0)  # skips the slow teardown of imported modules
