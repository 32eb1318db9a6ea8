"""Scans from elsewhere: folders of clouds with poses become a recording to be replayed.

agents     files, sensors, poses and times of each agent
poses      poses and mounts in tables and text files
alignment  refines mounts by what the sensors see together
ground     fits the ground to scans and poses
mutual     finds agents whose poses contradict those of others
importer   writes the recording, over an open ground
"""
