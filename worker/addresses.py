"""Which addresses are public, so that webhooks may send messages to them."""

from ipaddress import IPv4Address, IPv6Address, IPv6Network, ip_address

_NAT64 = IPv6Network("64:ff9b::/96")  # RFC 6052: the last 32 bits are an IPv4 address


def is_public(address: str) -> bool:
    """Return whether an address is public.

    Loopback, private and link-local networks, addresses shared behind a provider's NAT, multicast
    and reserved addresses are not, nor are IPv6 addresses that contain such an IPv4 address.

    Raises
    ------
    ValueError
        If it is no address.
    """
    found: IPv4Address | IPv6Address = ip_address(address)
    if isinstance(found, IPv6Address):
        within = _ipv4_within(found)
        if within is not None:
            found = within
        elif found.is_site_local:
            return False
    return found.is_global and not (found.is_multicast or found.is_reserved)


def _ipv4_within(address: IPv6Address) -> IPv4Address | None:
    if address in _NAT64:
        return IPv4Address(int(address) & 0xFFFFFFFF)
    if address.teredo is not None:
        return address.teredo[1]
    return address.ipv4_mapped or address.sixtofour
