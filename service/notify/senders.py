"""One attempt to deliver an event: a signed webhook, or a mail.  Raises OSError, or ValueError, when it fails."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import smtplib
import socket
import ssl
import threading
import time
from collections.abc import Sequence
from email.message import EmailMessage
from typing import Any

from sprung.service.access import outbound
from sprung.service.errors import UserError
from sprung.service.notify.events import sentence
from sprung.service.settings import Settings

SECONDS = 10.0
MAIL_SECONDS = 60.0  # of all that a mail server says; some greet slowly on purpose
SUCCESS = range(200, 300)
ENCODED = "whsec_"  # begins a secret in base64


def post(url: str, event: dict[str, Any], secret: str | None, allowed: Sequence[outbound.Network] = ()) -> None:
    """CloudEvents in structured mode, signed as Standard Webhooks (standardwebhooks.com) has it.

    allowed: networks that may be called although they are not public.  A receiver that moved must be told of in the
    settings: signed events do not follow anybody's pointer.
    """
    body = json.dumps(event, allow_nan=False).encode()
    headers = {"Content-Type": "application/cloudevents+json", "User-Agent": "sprung"}
    headers |= signature(event["id"], int(time.time()), body, secret)
    status = outbound.post(url, body, headers, allowed, SECONDS)
    if status not in SUCCESS:
        raise ValueError(f"the receiver answered {status}")


def signature(identity: str, seconds: int, body: bytes, secret: str | None) -> dict[str, str]:
    """Headers `webhook-id`, `webhook-timestamp` and, with a secret, `webhook-signature`.

    HMAC-SHA256 over `ID.TIMESTAMP.BODY`, base64; the timestamp lets receivers refuse what was replayed.
    """
    headers = {"webhook-id": identity, "webhook-timestamp": str(seconds)}
    if secret:
        digest = hmac.new(signing_key(secret), f"{identity}.{seconds}.".encode() + body, hashlib.sha256).digest()
        headers["webhook-signature"] = f"v1,{base64.b64encode(digest).decode()}"
    return headers


def signing_key(secret: str | None) -> bytes:
    """The bytes that a secret stands for.  Raises UserError where it begins as one in base64 and is none."""
    if secret is None or not secret.startswith(ENCODED):
        return (secret or "").encode()
    try:
        return base64.b64decode(secret.removeprefix(ENCODED), validate=True)
    except ValueError:
        raise UserError(
            f"setting webhook_secret (SPRUNG_WEBHOOK_SECRET): what follows {ENCODED} is no base64"
        ) from None


class _BoundedSmtp(smtplib.SMTP):
    """Hung up on when all of it takes long: the time-out of a socket restarts with every byte, and servers that slow
    down strangers send them one by one."""

    _ended: threading.Timer | None = None

    def _get_socket(self, host: str, port: int, timeout: float) -> socket.socket:
        line: socket.socket = super()._get_socket(host, port, timeout)  # type: ignore[misc]  # a hook that typeshed leaves out
        self._ended = outbound.hung_up_after(line, MAIL_SECONDS)
        return line

    def close(self) -> None:
        if self._ended is not None:
            self._ended.cancel()
        super().close()


def mail(settings: Settings, address: str, event: dict[str, Any]) -> None:
    """A plain mail with the sentence, what to do, and where to look."""
    message = EmailMessage()
    message["From"], message["To"] = settings.mail_from, address
    message["Subject"] = sentence(event)
    message["Message-ID"] = f"<{event['id']}@sprung>"
    lines = [sentence(event), event["data"].get("advisory") or "", *event["data"].get("findings", [])]
    lines += [event["data"]["page"], "", json.dumps(event, indent=1)]
    message.set_content("\n".join(line for line in lines if line is not None))
    with _BoundedSmtp(settings.smtp_host, settings.smtp_port, timeout=SECONDS) as server:
        if settings.smtp_starttls:
            server.starttls(context=ssl.create_default_context())
        if settings.smtp_user and settings.smtp_password:
            server.login(settings.smtp_user, settings.smtp_password)
        server.send_message(message)
