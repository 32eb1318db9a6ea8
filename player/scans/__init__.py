"""Scans from elsewhere: folders of clouds with poses become a tape that is played as any other."""
