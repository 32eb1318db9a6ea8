"""Import of scans from other sources: folders of clouds with poses become a recording to replay.

agents     files, sensors, poses and times of each agent
poses      poses and mounts in tables and text files
alignment  refines mounts by registration of overlapping clouds
ground     fits the ground to scans and poses
mutual     finds agents whose poses contradict those of others
importer   writes the recording, on a synthetic open ground
"""
