"""Weights are taken only with a signature, where a key is named."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("cryptography")
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from sprung.service.errors import UserError
from sprung.service.monitoring.engine import load_engine
from sprung.service.monitoring.signed import check_signature
from sprung.service.settings import Settings


@pytest.fixture
def signed(tmp_path: Path) -> tuple[Path, Path]:
    """A folder with a signed manifest, and the public key."""
    pair, key = Ed25519PrivateKey.generate(), tmp_path / "key.pem"
    key.write_bytes(pair.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    (tmp_path / "manifest.json").write_text("{}")
    (tmp_path / "manifest.json.sig").write_bytes(pair.sign(b"{}"))
    return tmp_path, key


def test_a_signature_of_this_very_manifest_is_good(signed: tuple[Path, Path]) -> None:
    check_signature(*signed)
    (signed[0] / "manifest.json").write_text('{"other": 1}')
    with pytest.raises(UserError, match="not a signature of the manifest"):
        check_signature(*signed)


@pytest.mark.parametrize(("file", "why"), [("manifest.json.sig", "must be signed"), ("key.pem", "must be signed")])
def test_what_is_missing_is_named(signed: tuple[Path, Path], file: str, why: str) -> None:
    (signed[0] / file).unlink()
    with pytest.raises(UserError, match=f"{file}.*{why}"):
        check_signature(*signed)


def test_a_key_of_another_kind_is_refused(signed: tuple[Path, Path]) -> None:
    signed[1].write_text("no key")
    with pytest.raises(UserError, match="Ed25519"):
        check_signature(*signed)


def test_the_service_does_not_start_with_weights_that_are_not_signed(signed: tuple[Path, Path]) -> None:
    (signed[0] / "manifest.json.sig").write_bytes(bytes(64))
    with pytest.raises(UserError, match="not a signature"):
        load_engine(Settings(weights=signed[0], weights_key=signed[1]))
