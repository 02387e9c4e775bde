"""Addresses, and pages at them."""

import socket
import urllib.request

import pytest

from armsight.app.show.http import Pages, host_and_port
from armsight.errors import InputError


@pytest.mark.parametrize(
    ("address", "parts"),
    [
        ("127.0.0.1:8799", ("127.0.0.1", 8799)),
        ("[::1]:8799", ("::1", 8799)),
        ("hub.local:0", ("hub.local", 0)),
        ("hub.local:65535", ("hub.local", 65535)),
    ],
)
def test_an_address_has_two_parts(address, parts):
    assert host_and_port(address, "--http") == parts


@pytest.mark.parametrize(("address", "least"), [("nowhere", 0), (":80", 0), ("a:65536", 0), ("a:-1", 0), ("a:0", 1)])
def test_what_is_no_address_is_said(address, least):
    with pytest.raises(InputError, match="expected HOST:PORT"):
        host_and_port(address, "--http", least=least)


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_pages_are_for_this_computer_by_either_address(host):
    try:
        socket.create_server((host.strip("[]"), 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError:
        pytest.skip("this computer has no such address")
    pages = Pages(f"{host}:0", {"/": lambda query: (200, "text/plain", b"here")}, "--http")
    try:
        assert pages.address == f"http://{host}:{pages.port}/"
        with urllib.request.urlopen(pages.address) as answer:
            assert answer.read() == b"here"
    finally:
        pages.close()
