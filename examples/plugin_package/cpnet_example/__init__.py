"""Plug-ins for cpnet, one of each kind."""
