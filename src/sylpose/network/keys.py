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
    now, written = datetime.now(UTC), list[Path]()
    ca_file, ca_key_file = folder / "ca.pem", folder / "ca.key"

    def issue(stem: str, issuer: tuple[ec.EllipticCurvePrivateKey, x509.Name] | None, *extensions: Any) -> None:
        """Write a new key and its certificate; without issuer, those of the authority."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, stem if issuer else "sylpose")])
        signer, authority = issuer or (key, subject)
        builder = x509.CertificateBuilder().subject_name(subject).issuer_name(authority).public_key(key.public_key())
        builder = builder.serial_number(x509.random_serial_number()).not_valid_before(now - timedelta(days=1))
        builder = builder.not_valid_after(now + timedelta(days=VALIDITY_DAYS))
        for extension in extensions:
            builder = builder.add_extension(extension, critical=issuer is None)
        no_password = serialization.NoEncryption()
        secret = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, no_password)
        public = builder.sign(signer, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
        for suffix, data, mode in ((".key", secret, 0o600), (".pem", public, 0o644)):
            with replace_atomically(folder / f"{stem}{suffix}", mode=mode) as part:
                part.write_bytes(data)
            written.append(folder / f"{stem}{suffix}")

    if not ca_file.exists():
        issue("ca", None, x509.BasicConstraints(ca=True, path_length=0))
    elif not ca_key_file.exists():
        raise ValueError(f"{ca_key_file}: missing, so {ca_file.name} cannot issue keys")
    ca_key = serialization.load_pem_private_key(ca_key_file.read_bytes(), None)
    assert isinstance(ca_key, ec.EllipticCurvePrivateKey)
    issuer = ca_key, x509.load_pem_x509_certificate(ca_file.read_bytes()).subject
    alternatives = x509.SubjectAlternativeName([_parse_host(host) for host in ("localhost", "127.0.0.1", *hosts)])
    usage = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
    for name in (*names, OBSERVER):
        if not (folder / f"{name}.pem").exists():
            issue(name, issuer, alternatives, usage)
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

    def make_rule(name: str, flows: list[str], messages: list[str], key: str) -> dict[str, Any]:
        return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": [key]}

    declarations = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query", "reply"]
    sent = ["put", "delete", "liveliness_token"]
    subscribe_rule = make_rule("listens", ["ingress", "egress"], declarations, "sylpose/**")
    receive_rule = make_rule("receives", ["egress"], sent, "sylpose/**")
    publish_rules = [make_rule(f"speaks-{name}", ["ingress"], sent, f"sylpose/*/*/*/{name}/**") for name in names]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [subscribe_rule, receive_rule, *publish_rules],
        "subjects": [{"id": "anyone"}, *({"id": f"is-{name}", "cert_common_names": [name]} for name in names)],
        "policies": [
            {"rules": ["listens", "receives"], "subjects": ["anyone"]},
            *({"rules": [f"speaks-{name}"], "subjects": [f"is-{name}"]} for name in names),
        ],
    }
