"""What of a scan an agent sends, in which order, and when it stops."""
