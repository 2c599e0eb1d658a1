"""Keys for a network of nodes: a certificate authority of the operator's own, and a key for each camera.

One folder, `ca.pem` and for each name `NAME.pem` and `NAME.key`; the operator copies ca.pem and a camera's own two files to
its machine. `ca.key` makes further keys and stays where it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from sylpose.atomic_io import output_folder, replacing

__all__ = ["LISTENER", "access_rules", "make_keys", "tls_settings"]

# Days for which keys are good (choice: the life of a rig).
DAYS = 3650
# Who listens only has a key of this name, too (choice).
LISTENER = "viewer"


def make_keys(folder: Path, names: Sequence[str], hosts: Sequence[str] = ()) -> list[Path]:
    """Make a certificate authority, and a key for each name; what is there already is kept.

    Args:
        hosts: names and addresses of the machines, besides localhost.

    Returns:
        the files written.

    Raises:
        ValueError: a folder with a certificate authority that lost its key; a camera that is called like another key.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

    for name in {LISTENER, "ca", "sylpose"} & set(names):
        raise ValueError(f"camera {name!r}: the key of that name is another one's")
    output_folder(folder)
    now, written = datetime.now(UTC), []

    def subject(name: str) -> x509.Name:
        return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])

    def put(path: Path, data: bytes, *, secret: bool) -> None:
        with replacing(path, mode=0o600 if secret else 0o644) as part:
            part.write_bytes(data)
        written.append(path)

    def pem(key: ec.EllipticCurvePrivateKey) -> bytes:
        return key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )

    def certificate(name: str, public: ec.EllipticCurvePublicKey, issuer: x509.Name) -> x509.CertificateBuilder:
        return (
            x509.CertificateBuilder()
            .subject_name(subject(name))
            .issuer_name(issuer)
            .public_key(public)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - timedelta(days=1))
            .not_valid_after(now + timedelta(days=DAYS))
        )

    ca_file, ca_key_file = folder / "ca.pem", folder / "ca.key"
    if ca_file.exists() and not ca_key_file.exists():
        raise ValueError(f"{ca_key_file}: not there, so no keys can be made for {ca_file.name}")
    if ca_file.exists():
        loaded = serialization.load_pem_private_key(ca_key_file.read_bytes(), None)
        assert isinstance(loaded, ec.EllipticCurvePrivateKey)
        ca_key, authority = loaded, x509.load_pem_x509_certificate(ca_file.read_bytes()).subject
    else:
        ca_key, authority = ec.generate_private_key(ec.SECP256R1()), subject("sylpose")
        ca = (
            certificate("sylpose", ca_key.public_key(), authority)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .sign(ca_key, hashes.SHA256())
        )
        put(ca_key_file, pem(ca_key), secret=True)
        put(ca_file, ca.public_bytes(serialization.Encoding.PEM), secret=False)
    alternatives = [_host(host) for host in ("localhost", "127.0.0.1", *hosts)]
    for name in (*names, LISTENER):
        if (folder / f"{name}.pem").exists():
            continue
        key = ec.generate_private_key(ec.SECP256R1())
        signed = (
            certificate(name, key.public_key(), authority)
            .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
                critical=False,
            )
            .sign(ca_key, hashes.SHA256())
        )
        put(folder / f"{name}.key", pem(key), secret=True)
        put(folder / f"{name}.pem", signed.public_bytes(serialization.Encoding.PEM), secret=False)
    return written


def _host(host: str) -> Any:
    from ipaddress import ip_address

    from cryptography import x509

    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def tls_settings(folder: Path, name: str) -> dict[str, Any]:
    """Of mutual TLS.

    Raises:
        ValueError: a file that is not there.
    """
    ca, certificate, key = folder / "ca.pem", folder / f"{name}.pem", folder / f"{name}.key"
    for file in (ca, certificate, key):
        if not file.is_file():
            raise ValueError(f"{file}: no such file; `sylpose network init` makes keys")
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


def access_rules(names: Sequence[str]) -> dict[str, Any]:
    """Who may say what: everyone listens, and speaks under its own name alone.

    Args:
        names: of the cameras.
    """
    everything = "sylpose/**"
    listens = {
        "id": "listens",
        "permission": "allow",
        "flows": ["ingress", "egress"],
        "messages": ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query", "reply"],
        "key_exprs": [everything],
    }
    receives = {
        "id": "receives",
        "permission": "allow",
        "flows": ["egress"],
        "messages": ["put", "delete", "liveliness_token"],
        "key_exprs": [everything],
    }
    speaks = [
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
        "rules": [listens, receives, *speaks],
        "subjects": [
            {"id": "anyone"},
            *({"id": f"is-{name}", "cert_common_names": [name]} for name in names),
        ],
        "policies": [
            {"rules": ["listens", "receives"], "subjects": ["anyone"]},
            *({"rules": [f"speaks-{name}"], "subjects": [f"is-{name}"]} for name in names),
        ],
    }
