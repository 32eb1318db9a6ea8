"""What stands in the kernel."""

from pathlib import Path

from link_relay.netns.enter import NAMESPACES
from link_relay.netns.place import Place


def made_by(pid: int) -> list[str]:
    """Returns the namespaces and devices that a process has made and that are there."""
    folders = (NAMESPACES, Path("/sys/class/net"))
    names = [entry.name for folder in folders for entry in folder.glob("cp*")]
    return [name for name in names if (place := Place.of(name)) and place.pid == pid]
