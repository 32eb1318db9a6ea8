"""Scans from elsewhere: folders of clouds with poses become a recording to be replayed.

agents     files, sensors, poses and times of each agent
poses      poses and mounts in tables and text files
alignment  refines mounts by what the sensors see together
importer   writes the recording, over an open ground
"""
