"""Weights that somebody answers for: the manifest of a trained estimator, which holds their SHA-256, is signed.

Ed25519 (RFC 8032), as `openssl pkeyutl -sign -rawin` makes it.  Who can exchange the files can exchange a digest that
lies beside them, but not a signature.
"""

from __future__ import annotations

from pathlib import Path

from sprung.service.errors import UserError


def check_signature(directory: Path, key: Path) -> None:
    """Raise UserError unless `manifest.json.sig` in a folder of weights is the signature of its manifest by a key.

    key: public, PEM.
    """
    try:
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
        from cryptography.hazmat.primitives.serialization import load_pem_public_key
    except ImportError:
        raise UserError("signed weights need the package cryptography; pip install 'sprung[signed]'") from None
    try:
        public = load_pem_public_key(key.read_bytes())
        signature = (directory / "manifest.json.sig").read_bytes()
        manifest = (directory / "manifest.json").read_bytes()
    except OSError as error:
        raise UserError(f"{error.filename}: {error.strerror}; weights must be signed (SPRUNG_WEIGHTS_KEY)") from None
    except ValueError:
        public = None
    if not isinstance(public, Ed25519PublicKey):
        raise UserError(f"{key}: not the public key of an Ed25519 pair in PEM")
    try:
        public.verify(signature, manifest)
    except InvalidSignature:
        raise UserError(f"{directory}/manifest.json.sig: not a signature of the manifest by {key}") from None
