"""The last module that the fork server imports, see `cpnet.fork_server`; nobody else does."""

import atexit
import gc
import os

gc.freeze()  # what was imported stays: no collection of those that are forked off need look at it
atexit.register(os._exit, 0)  # to take it all apart would take longer than who waits has patience
