"""X.509 certificates of a fleet: ECDSA keys on the curve P-256, signatures with SHA-256.

Zenoh (rustls) and Python's `ssl` accept them.
"""

from __future__ import annotations

import ipaddress
from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from beamsplat.common.errors import UserError, reason

_ORGANIZATION = "BeamSplat"
_AUTHORITY = "BeamSplat authority"  # common name of the root certificate


def new_key() -> ec.EllipticCurvePrivateKey:
    """Return a new private key."""
    return ec.generate_private_key(ec.SECP256R1())


def key_as_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    """Return a private key, unencrypted, as the content of a PEM file."""
    return key.private_bytes(Encoding.PEM, PrivateFormat.TraditionalOpenSSL, NoEncryption())


def certificate_as_pem(certificate: x509.Certificate) -> bytes:
    """Return a certificate as the content of a PEM file."""
    return certificate.public_bytes(Encoding.PEM)


def read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """Read a private key from a PEM file.

    Raises:
        UserError: the file is missing, or contains no unencrypted ECDSA key.
    """
    try:
        key = load_pem_private_key(path.read_bytes(), password=None)
    except (OSError, ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise UserError(f"{path}: no private key can be read ({reason(error)})") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise UserError(f"{path}: not an ECDSA key")
    return key


def read_certificate(path: Path) -> x509.Certificate:
    """Read a certificate from a PEM file.

    Raises:
        UserError: the file is missing, or contains no certificate.
    """
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: no certificate can be read ({reason(error)})") from error


def common_name(certificate: x509.Certificate) -> str:
    """Return the common name of a certificate's subject: the name of the host; "nobody" if there is none."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else "nobody"


def is_issued_by(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    """Return whether an authority has signed a certificate; the dates of both are not checked."""
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def make_root_certificate(
    key: ec.EllipticCurvePrivateKey, valid_from: datetime, days: int
) -> x509.Certificate:
    """Return the certificate of an authority, which it signs itself with its key."""
    name = _name(_AUTHORITY)
    return (
        _builder(name, key.public_key(), name, key, valid_from, days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(is_authority=True), critical=True)
        .sign(key, hashes.SHA256())
    )


def make_host_certificate(
    name: str,
    addresses: tuple[str, ...],
    key: ec.EllipticCurvePrivateKey,
    authority: tuple[x509.Certificate, ec.EllipticCurvePrivateKey],
    valid_from: datetime,
    days: int,
) -> x509.Certificate:
    """Return a certificate of a host for both sides of a TLS link.

    Args:
        name: common name of the certificate; also one of its addresses.
        addresses: DNS names and IP addresses of the host.
        key: private key of the host.
        authority: certificate and private key of the authority that signs.
        valid_from: start of the validity.
        days: validity in days.

    Raises:
        UserError: a name or address cannot be part of a certificate.
    """
    issuer, issuer_key = authority
    try:
        return (
            _builder(_name(name), key.public_key(), issuer.subject, issuer_key, valid_from, days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(is_authority=False), critical=True)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
                critical=False,
            )
            .add_extension(
                x509.SubjectAlternativeName([_general_name(a) for a in dict.fromkeys((name, *addresses))]),
                critical=False,
            )
            .sign(issuer_key, hashes.SHA256())
        )
    except ValueError as error:
        raise UserError(f"{name}: no certificate can be made: {error}") from error


def _builder(
    name: x509.Name,
    key: ec.EllipticCurvePublicKey,
    issuer: x509.Name,
    issuer_key: ec.EllipticCurvePrivateKey,
    valid_from: datetime,
    days: int,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(valid_from)
        .not_valid_after(valid_from + timedelta(days=days))
        # Python 3.13 and later require both identifiers.
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key()), critical=False
        )
    )


def _name(name: str) -> x509.Name:
    organization = x509.NameAttribute(NameOID.ORGANIZATION_NAME, _ORGANIZATION)
    return x509.Name([organization, x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _key_usage(is_authority: bool) -> x509.KeyUsage:
    """Return the purposes of a key: signing certificates (an authority) or TLS handshakes (a host)."""
    return x509.KeyUsage(
        digital_signature=not is_authority, content_commitment=False, key_encipherment=False,
        data_encipherment=False, key_agreement=False, key_cert_sign=is_authority, crl_sign=is_authority,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _general_name(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        return x509.DNSName(address)
