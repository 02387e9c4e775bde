"""The keys of a site: an authority, a certificate for the hub and one for each cell, and requests that it signs."""

from __future__ import annotations

import ipaddress
import json
import os
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from armsight.app.stream.cell_file import certificate, check_name, hold_bytes
from armsight.errors import InputError
from armsight.files import as_input_error, read_bytes, read_text, replacing, write_text

#: days that certificates of cells and hub, and of the site, are valid; half: renewed more often, double: stolen longer.
_DAYS, _CA_DAYS = 397, 3650
#: days before its end in which a certificate is made anew; half: less warning, double: made anew more often.
_RENEW_DAYS = 30
#: Name of the hub's certificate.
HUB = "hub"
_CELL = """name = "{}"
site = "{}"
router = ""
ca = "ca.pem"
certificate = "cell.pem"
key = "cell.key"
holds = false  # true: the hub may ask this cell to hold its arm
"""
#: A certificate and its private key.
_Pair = tuple[x509.Certificate, ec.EllipticCurvePrivateKey]


def make_keys(folder: Path, site: str, cells: Sequence[str], host: str, port: int) -> list[Path]:
    """Make what a site lacks: the authority, the hub's certificate, and a folder a cell with its cell.toml.

    Cells that have a valid certificate keep it; host and port are where they find the hub. ``ca.key`` must stay secret.
    Returned are the files of cells that are new or changed, each to be carried to its cell. An InputError says that a
    name cannot be part of a key, or that the folder is another site's.
    """
    for name in (site, *cells):
        check_name(name, "the name of a site or a cell")
    if HUB in cells:
        raise InputError(f"a cell cannot be called {HUB}: that is the hub's own certificate")
    if not (folder / "ca.pem").exists():
        _ensure(folder / "ca", None, site, [])
    authority = certificate(folder / "ca.pem"), _private(folder / "ca.key")
    if (name := _common_name(authority[0])) != site:
        raise InputError(f"{folder}: these are the keys of site {name}, not of {site}: give another folder with -o")
    _ensure(folder / HUB, authority, f"{site}.{HUB}", [host, "localhost", "127.0.0.1"])
    router = f'router = "tls/[{host}]:{port}"' if ":" in host else f'router = "tls/{host}:{port}"'
    made = []
    for name in cells:
        toml = folder / "cells" / name / "cell.toml"
        if new := _ensure(toml.with_name("cell"), authority, f"{site}.{name}", []):
            write_text(toml.with_name("ca.pem"), read_text(folder / "ca.pem"))
        before = read_text(toml) if toml.exists() else _CELL.format(name, site)  # what its owner changed in it stays
        now = re.sub(r"(?m)^router = .*$", router, before)
        if new or now != before:
            write_text(toml, now)
            made.append(toml)
    return made


def site_of(folder: Path) -> tuple[str, list[str]]:
    """Return the name of a folder's site, and of its cells; an InputError: it has no keys, or a certificate has ended."""
    if not (folder / "ca.pem").is_file():
        raise InputError(
            f"{folder}: no keys of a site are here: make them with `armsight hub keys SITE CELL ... -o {folder}`"
        )
    certificate(folder / f"{HUB}.pem")
    cells = sorted(path.parent.name for path in folder.glob("cells/*/cell.pem"))
    return _common_name(certificate(folder / "ca.pem")), cells


def sign_hold(folder: Path, cell: str, text: str) -> bytes:
    """Return a request that a cell holds its arm, signed by the authority of a folder."""
    t = round(datetime.now(UTC).timestamp(), 3)
    signed = hold_bytes(site_of(folder)[0], cell, t, text)
    signature = _private(folder / "ca.key").sign(signed, ec.ECDSA(hashes.SHA256()))
    return json.dumps({"t": t, "text": text, "signature": signature.hex()}).encode()


def _ensure(path: Path, authority: _Pair | None, name: str, hosts: list[str]) -> bool:
    """Make PATH.pem and PATH.key where they are missing, end soon or lack a host; return whether they were made."""
    pem, now = path.with_suffix(".pem"), datetime.now(UTC)
    if pem.exists() and path.with_suffix(".key").exists():
        found = certificate(pem, ended=True)
        names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value if hosts else ()
        had = {str(each.value) for each in names}
        if found.not_valid_after_utc - now > timedelta(days=_RENEW_DAYS) and set(hosts) <= had:
            return False
        hosts = sorted({*hosts, *had})
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    issuer, signing = (subject, key) if authority is None else (authority[0].subject, authority[1])
    end = now + timedelta(days=_CA_DAYS if authority is None else _DAYS)
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key.public_key())
    builder = builder.serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(now - timedelta(hours=1)).not_valid_after(end)
    own = x509.BasicConstraints(authority is None, 0 if authority is None else None)
    builder = builder.add_extension(own, critical=True)
    if authority is not None:
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
        builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName(list(map(_alternative, hosts))), critical=False)
    made = builder.sign(signing, hashes.SHA256())
    encoding, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    with replacing(path.with_suffix(".key"), "wb") as file:
        os.chmod(file.name, 0o600)
        file.write(key.private_bytes(encoding, pkcs8, serialization.NoEncryption()))
    with replacing(pem, "wb") as file:
        file.write(made.public_bytes(encoding))
    return True


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        if not re.fullmatch(r"[A-Za-z0-9.-]{1,253}", host):
            raise InputError(f"{host!r} is no name of a computer: expected a host name or an address") from None
        return x509.DNSName(host)


def _private(path: Path) -> ec.EllipticCurvePrivateKey:
    with as_input_error(f"{path}: no private key is in it: make the site's keys anew", ValueError, TypeError):
        key = serialization.load_pem_private_key(read_bytes(path), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    return key


def _common_name(found: x509.Certificate) -> str:
    return str(found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
