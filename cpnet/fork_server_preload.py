"""The last module that the fork server imports, see `cpnet.fork_server`; no other process does."""

import atexit
import gc
import os

gc.freeze()  # imported objects stay: the garbage collectors of forked processes need not scan them
atexit.register(os._exit, 0)  # skips the slow teardown of imported modules
