"""TLS keys of a network of nodes: a private certificate authority and a key for each camera.

A folder contains `ca.pem` and, for each name, `NAME.pem` and `NAME.key`. The operator copies ca.pem and a camera's own
two files to its machine. `ca.key` issues further keys and must stay in place.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from sylpose.atomic_io import make_output_folder, replace_atomically

__all__ = ["OBSERVER", "build_access_rules", "build_tls_settings", "make_keys"]

# Validity of the keys, days (choice: the life of a rig).
VALIDITY_DAYS = 3650
# Name of the key for observers that only receive (choice).
OBSERVER = "viewer"


def make_keys(folder: Path, names: Sequence[str], hosts: Sequence[str] = ()) -> list[Path]:
    """Create a certificate authority and a key for each name; existing files are kept.

    Args:
        folder: where the files are.
        names: names of the cameras.
        hosts: host names and addresses of the machines, in addition to localhost.

    Returns:
        The files written.

    Raises:
        ValueError: a certificate authority without its key, or a camera with a reserved name.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    for name in {OBSERVER, "ca", "sylpose"} & set(names):
        raise ValueError(f"camera {name!r}: this name is reserved for another key")
    make_output_folder(folder)
    now, written = datetime.now(UTC), []

    def make_name(name: str) -> x509.Name:
        return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])

    def write_file(path: Path, data: bytes, *, secret: bool) -> None:
        with replace_atomically(path, mode=0o600 if secret else 0o644) as part:
            part.write_bytes(data)
        written.append(path)

    def encode_private_key(key: ec.EllipticCurvePrivateKey) -> bytes:
        return key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )

    def make_builder(name: str, public: ec.EllipticCurvePublicKey, issuer: x509.Name) -> x509.CertificateBuilder:
        return (
            x509.CertificateBuilder()
            .subject_name(make_name(name))
            .issuer_name(issuer)
            .public_key(public)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - timedelta(days=1))
            .not_valid_after(now + timedelta(days=VALIDITY_DAYS))
        )

    ca_file, ca_key_file = folder / "ca.pem", folder / "ca.key"
    if ca_file.exists() and not ca_key_file.exists():
        raise ValueError(f"{ca_key_file}: missing, so {ca_file.name} cannot issue keys")
    if ca_file.exists():
        loaded = serialization.load_pem_private_key(ca_key_file.read_bytes(), None)
        assert isinstance(loaded, ec.EllipticCurvePrivateKey)
        ca_key, authority = loaded, x509.load_pem_x509_certificate(ca_file.read_bytes()).subject
    else:
        ca_key, authority = ec.generate_private_key(ec.SECP256R1()), make_name("sylpose")
        ca = (
            make_builder("sylpose", ca_key.public_key(), authority)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .sign(ca_key, hashes.SHA256())
        )
        write_file(ca_key_file, encode_private_key(ca_key), secret=True)
        write_file(ca_file, ca.public_bytes(serialization.Encoding.PEM), secret=False)
    alternatives = [_parse_host(host) for host in ("localhost", "127.0.0.1", *hosts)]
    for name in (*names, OBSERVER):
        if (folder / f"{name}.pem").exists():
            continue
        key = ec.generate_private_key(ec.SECP256R1())
        signed = (
            make_builder(name, key.public_key(), authority)
            .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
                critical=False,
            )
            .sign(ca_key, hashes.SHA256())
        )
        write_file(folder / f"{name}.key", encode_private_key(key), secret=True)
        write_file(folder / f"{name}.pem", signed.public_bytes(serialization.Encoding.PEM), secret=False)
    return written


def _parse_host(host: str) -> Any:
    from ipaddress import ip_address

    from cryptography import x509

    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def build_tls_settings(folder: Path, name: str) -> dict[str, Any]:
    """Return the Zenoh settings for mutual TLS.

    Raises:
        ValueError: a missing file.
    """
    ca, certificate, key = folder / "ca.pem", folder / f"{name}.pem", folder / f"{name}.key"
    for file in (ca, certificate, key):
        if not file.is_file():
            raise ValueError(f"{file}: no such file; create keys with `sylpose network init`")
    return {
        "root_ca_certificate": str(ca.resolve()),
        "enable_mtls": True,
        "verify_name_on_connect": False,
        "listen_certificate": str(certificate.resolve()),
        "listen_private_key": str(key.resolve()),
        "connect_certificate": str(certificate.resolve()),
        "connect_private_key": str(key.resolve()),
        "close_link_on_expiration": True,
    }


def build_access_rules(names: Sequence[str]) -> dict[str, Any]:
    """Return Zenoh's access control: everyone may receive, and send only under its own name.

    Args:
        names: names of the cameras.
    """
    everything = "sylpose/**"
    subscribe_rule = {
        "id": "listens",
        "permission": "allow",
        "flows": ["ingress", "egress"],
        "messages": ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query", "reply"],
        "key_exprs": [everything],
    }
    receive_rule = {
        "id": "receives",
        "permission": "allow",
        "flows": ["egress"],
        "messages": ["put", "delete", "liveliness_token"],
        "key_exprs": [everything],
    }
    publish_rules = [
        {
            "id": f"speaks-{name}",
            "permission": "allow",
            "flows": ["ingress"],
            "messages": ["put", "delete", "liveliness_token"],
            "key_exprs": [f"sylpose/*/*/*/{name}/**"],
        }
        for name in names
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [subscribe_rule, receive_rule, *publish_rules],
        "subjects": [
            {"id": "anyone"},
            *({"id": f"is-{name}", "cert_common_names": [name]} for name in names),
        ],
        "policies": [
            {"rules": ["listens", "receives"], "subjects": ["anyone"]},
            *({"rules": [f"speaks-{name}"], "subjects": [f"is-{name}"]} for name in names),
        ],
    }
