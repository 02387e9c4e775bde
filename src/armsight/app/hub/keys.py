"""The keys of a site: an authority, a certificate for the hub and one for each cell, and requests that it signs."""

from __future__ import annotations

import ipaddress
import json
import os
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from armsight.app.stream.cell_file import check_name, hold_bytes
from armsight.errors import InputError
from armsight.files import read_bytes, read_text, replacing, write_text

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

#: days that certificates are valid: of cells and hub, and of the authority; half: renewed twice as often, double: a
#: stolen key works longer.
_DAYS, _CA_DAYS = 397, 3650
#: days before its end in which a certificate is made anew; half: less warning, double: made anew more often.
_RENEW_DAYS = 30
_CA, HUB, _CELLS = "ca", "hub", "cells"


def make_keys(folder: Path, site: str, cells: Sequence[str], host: str, port: int) -> list[Path]:
    """Make what a site lacks: the authority, the hub's certificate, and a folder a cell with its cell.toml.

    Args:
        folder: of the site's keys; ``ca.key`` in it must stay secret.
        site: its name.
        cells: names of cells; those that have a valid certificate keep it.
        host: under which cells find the hub.
        port: of the hub.

    Returns:
        The files of cells that are new or changed, each to be carried to its cell.

    Raises:
        InputError: a name that cannot be part of a key, a folder of another site, or cryptography is not installed.
    """
    _required()
    check_name(site, "the site's name")
    for name in cells:
        check_name(name, "a cell's name")
        if name == HUB:
            raise InputError(f"a cell cannot be called {HUB}: that is the hub's own certificate")
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    authority = _authority(folder, site)
    _ensure(folder / HUB, authority, f"{site}.{HUB}", [host, "localhost", "127.0.0.1"])
    made = []
    for name in cells:
        at = folder / _CELLS / name
        router = f"tls/[{host}]:{port}" if ":" in host else f"tls/{host}:{port}"
        named = {"name": name, "site": site, "router": router}
        named |= {"ca": "ca.pem", "certificate": "cell.pem", "key": "cell.key"}
        lines = [f"{key} = {json.dumps(value)}" for key, value in named.items()]
        if _ensure(at / "cell", authority, f"{site}.{name}", []):
            write_text(at / "ca.pem", (folder / "ca.pem").read_text())
            made.append(at / "cell.toml")
        if not (at / "cell.toml").exists():
            last = "holds = false  # true: the hub may ask this cell to hold its arm"
            write_text(at / "cell.toml", "\n".join([*lines, last]) + "\n")
        before = read_text(at / "cell.toml")  # what its owner changed in it stays; the hub's address follows
        now = re.sub(r"(?m)^router = .*$", lines[2], before)
        if now != before:
            write_text(at / "cell.toml", now)
            made.append(at / "cell.toml")
    return made


def site_of(folder: Path) -> tuple[str, list[str]]:
    """Return the name of a folder's site, and of its cells.

    Raises:
        InputError: it holds no keys, or a certificate has ended.
    """
    _required()
    if not (folder / "ca.pem").is_file():
        raise InputError(
            f"{folder}: no keys of a site are here: make them with `armsight hub keys SITE CELL ... -o {folder}`"
        )
    site = _common_name(_certificate(folder / "ca.pem"))
    _check_valid(folder / f"{HUB}.pem")
    return site, sorted(path.parent.name for path in folder.glob(f"{_CELLS}/*/cell.pem"))


def sign_hold(folder: Path, cell: str, text: str) -> bytes:
    """Return a request that a cell holds its arm, signed by the authority of a folder."""
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    site, _ = site_of(folder)
    t = round(datetime.now(UTC).timestamp(), 3)
    signature = _private(folder / "ca.key").sign(hold_bytes(site, cell, t, text), ec.ECDSA(hashes.SHA256()))
    return json.dumps({"t": t, "text": text, "signature": signature.hex()}).encode()


def _required() -> None:
    try:
        import cryptography  # noqa: F401 - whether it is there
    except ImportError:
        raise InputError('cryptography is not installed: pip install "armsight[cells]"') from None


def _authority(folder: Path, site: str) -> tuple[x509.Certificate, EllipticCurvePrivateKey]:
    if not (folder / "ca.pem").exists():
        _ensure(folder / _CA, None, site, [])
    found = _certificate(folder / "ca.pem"), _private(folder / "ca.key")
    if (name := _common_name(found[0])) != site:
        raise InputError(f"{folder}: these are the keys of site {name}, not of {site}: give another folder with -o")
    return found


def _ensure(
    path: Path, authority: tuple[x509.Certificate, EllipticCurvePrivateKey] | None, name: str, hosts: list[str]
) -> bool:
    """Make PATH.pem and PATH.key where they are missing, end soon or lack a host; return whether they were made."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    pem = path.with_suffix(".pem")
    if pem.exists() and path.with_suffix(".key").exists():
        found = _certificate(pem)
        if not _ends_soon(found) and set(hosts) <= _hosts(found):
            return False
        hosts = sorted({*hosts, *_hosts(found)} if hosts else ())
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now, own = datetime.now(UTC), authority is None
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if authority is None else authority[0].subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(days=_CA_DAYS if own else _DAYS))
        .add_extension(x509.BasicConstraints(ca=own, path_length=0 if own else None), critical=True)
    )
    if not own:
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
        builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        if hosts:
            names = x509.SubjectAlternativeName([_alternative(each) for each in hosts])
            builder = builder.add_extension(names, critical=False)
    certificate = builder.sign(key if authority is None else authority[1], hashes.SHA256())
    pkcs8 = serialization.PrivateFormat.PKCS8
    private = key.private_bytes(serialization.Encoding.PEM, pkcs8, serialization.NoEncryption())
    with replacing(path.with_suffix(".key"), "wb") as file:
        os.chmod(file.name, 0o600)
        file.write(private)
    with replacing(pem, "wb") as file:
        file.write(certificate.public_bytes(serialization.Encoding.PEM))
    return True


def _alternative(host: str) -> x509.GeneralName:
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        if not re.fullmatch(r"[A-Za-z0-9.-]{1,253}", host):
            raise InputError(f"{host!r} is no name of a computer: expected a host name or an address") from None
        return x509.DNSName(host)


def _hosts(certificate: x509.Certificate) -> set[str]:
    from cryptography import x509

    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return set()
    return {str(each.value) for each in names}


def _certificate(path: Path) -> x509.Certificate:
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(read_bytes(path))
    except ValueError:
        raise InputError(f"{path}: no certificate is in it: make the site's keys anew") from None


def _private(path: Path) -> EllipticCurvePrivateKey:
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    try:
        key = serialization.load_pem_private_key(read_bytes(path), None)
    except (ValueError, TypeError):
        raise InputError(f"{path}: no private key is in it: make the site's keys anew") from None
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    return key


def _common_name(certificate: x509.Certificate) -> str:
    from cryptography.x509.oid import NameOID

    return str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)


def _ends_soon(certificate: x509.Certificate) -> bool:
    return certificate.not_valid_after_utc - datetime.now(UTC) < timedelta(days=_RENEW_DAYS)


def _check_valid(path: Path) -> None:
    certificate, now = _certificate(path), datetime.now(UTC)
    if not certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc:
        ended = certificate.not_valid_after_utc.date()
        raise InputError(
            f"{path}: valid until {ended}, and this computer's date is {now.date()}: run `armsight hub keys` again"
        )
