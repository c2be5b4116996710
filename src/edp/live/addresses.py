"""Addresses to listen on: checked, resolved, and whether other computers reach them."""

from __future__ import annotations

import ipaddress
import socket
from dataclasses import dataclass

from edp.errors import ConfigError, brief

LOOPBACK = "127.0.0.1"
MAX_HOST = 253
"""Maximum number of characters of a host name (RFC 1035)."""


@dataclass(frozen=True)
class BindAddress:
    """Network address that a server of this computer binds.

    Attributes:
        host: host name as the user typed it.
        numeric: IP address that `host` stands for; the first one of a name.
        is_loopback: whether only programs of this computer reach every address of `host`.
    """

    host: str
    numeric: str
    is_loopback: bool

    @property
    def is_everywhere(self) -> bool:
        """Whether the address covers all network interfaces of this computer."""
        return ipaddress.ip_address(self.numeric).is_unspecified

    @property
    def reach(self) -> str:
        """Who reaches the address, in words."""
        if self.is_loopback:
            return "programs of this computer"
        if self.is_everywhere:
            return "every computer of every network that this one is connected to"
        return f"every computer of the network of {self.host}"


def resolve_bind(host: str, option: str) -> BindAddress:
    """Resolve a host name to an address of this computer.

    Args:
        host: IP address or name.
        option: option of the host, for messages.

    Raises:
        ConfigError: `host` is empty, too long or not printable, or nothing is known by this name.
    """
    what = f"{option}: got {brief(repr(host), 60)}"
    if not host.strip() or len(host) > MAX_HOST or not host.isprintable():
        raise ConfigError(
            f"{what}, expected an address or name of this computer; give {LOOPBACK} to keep other "
            "computers out, or 0.0.0.0 to listen on all networks"
        )
    try:
        entries = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, ValueError) as error:  # ValueError: a name that no encoding of names takes
        raise ConfigError(
            f"{what}, which is not known as an address or name ({brief(error)}); give {LOOPBACK} "
            "or an address of this computer"
        ) from error
    # An IPv6 address may have a zone behind a percent sign.
    addresses = [str(entry[4][0]).partition("%")[0] for entry in entries]
    return BindAddress(host, addresses[0], all(ipaddress.ip_address(one).is_loopback for one in addresses))
