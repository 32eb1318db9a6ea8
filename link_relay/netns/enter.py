"""Sockets of another network namespace."""

from __future__ import annotations

import ctypes
import os
import socket
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from link_relay.netns.iproute import NetnsError

NAMESPACES = Path("/run/netns")
_CLONE_NEWNET = 0x40000000
_libc = ctypes.CDLL(None, use_errno=True)


def socket_in(namespace: str, kind: socket.SocketKind) -> socket.socket:
    """Returns an IPv4 socket that lives in a namespace, whoever uses it.

    A socket belongs to the namespace of the thread that made it: here one that then ends. (Python
    has `os.setns` from 3.12 on only.)

    Raises:
        NetnsError: the namespace cannot be entered.
    """
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(_make, namespace, kind).result()


def _make(namespace: str, kind: socket.SocketKind) -> socket.socket:
    try:
        entry = os.open(NAMESPACES / namespace, os.O_RDONLY)
        try:
            if _libc.setns(entry, _CLONE_NEWNET) != 0:
                number = ctypes.get_errno()
                raise OSError(number, os.strerror(number))
            return socket.socket(socket.AF_INET, kind)
        finally:
            os.close(entry)
    except OSError as error:
        raise NetnsError(f"cannot enter namespace {namespace}: {error.strerror}") from None
