"""Who may drive the environments of a server: TLS, client certificates and tokens, as in `isodream env serve`."""

from __future__ import annotations

import hashlib
import ipaddress
import re
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import grpc.aio

ROLES = ("actor", "learner", "viewer")
HEALTH = "/grpc.health.v1.Health/"
TOKEN = re.compile("[!-~]{16,}")


class SecurityError(Exception):
    """Certificates or tokens that cannot be used, or a server that nothing would guard."""


@dataclass(frozen=True)
class Secrets:
    """The files that a server's security comes from. Without any, it opens on loopback addresses only."""

    cert: Path | None = None
    """The server's certificate chain (PEM): turns TLS on."""
    key: Path | None = None
    """The certificate's private key (PEM)."""
    client_ca: Path | None = None
    """Clients must show a certificate of these authorities (PEM)."""
    tokens: Path | None = None
    """The tokens that are taken: lines `ROLE TOKEN`, where a role is actor, learner or viewer."""

    @classmethod
    def of(cls, folder: str | Path) -> Secrets:
        """Mutual TLS and tokens from a folder that `isodream secrets` made."""
        folder = Path(folder)
        return cls(folder / "server.pem", folder / "server.key", folder / "ca.pem", folder / "tokens")

    def check(self, address: str, *, insecure: bool) -> None:
        """Whether a server with these secrets may listen on `address` (`host:port`).

        Raises:
            SecurityError: if other machines could reach it and nothing guards it.
            ValueError: if it is no address.
        """
        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal():
            raise ValueError(f"`{address}` is not an address; write host:port")
        if insecure or self.tokens or self.client_ca:
            return
        for found in socket.getaddrinfo(host.strip("[]"), None, type=socket.SOCK_STREAM):
            ip = ipaddress.ip_address(found[4][0])
            if not (getattr(ip, "ipv4_mapped", None) or ip).is_loopback:
                raise SecurityError(
                    f"{ip} can be reached from other machines, and nothing guards it: give secrets=DIR "
                    "(`isodream secrets DIR` makes it), or insecure=True on a network that you trust"
                )

    def credentials(self) -> grpc.ServerCredentials | None:
        """Certificates for the listener; None speaks plain TCP.

        Raises:
            SecurityError: if a file cannot be used, or belongs to another that is missing.
        """
        if (self.cert is None) != (self.key is None):
            raise SecurityError("a certificate and its key come together: give both cert and key, or neither")
        if self.cert is None or self.key is None:
            if self.client_ca:
                raise SecurityError("client_ca is given without cert: clients show certificates only over TLS")
            return None
        pair = (_pem(self.key, "PRIVATE KEY"), _pem(self.cert, "CERTIFICATE"))
        authorities = _pem(self.client_ca, "CERTIFICATE") if self.client_ca else None
        return grpc.ssl_server_credentials([pair], authorities, require_client_auth=authorities is not None)

    def guards(self) -> list[grpc.aio.ServerInterceptor]:
        """The check of tokens in front of every call.

        Raises:
            SecurityError: if the file of tokens makes no sense.
        """
        return [_Guard(_parse(self.tokens))] if self.tokens else []


class _Guard(grpc.aio.ServerInterceptor):
    """Lets calls through whose token allows them; those to the health service need none."""

    def __init__(self, roles: dict[bytes, str]) -> None:
        self._roles = roles

    async def intercept_service(self, continuation: Any, handler_call_details: grpc.HandlerCallDetails) -> Any:
        if not handler_call_details.method.startswith(HEALTH):
            metadata = dict(handler_call_details.invocation_metadata)
            if refusal := self._refusal(str(metadata.get("authorization", ""))):

                async def refuse(_requests: Any, context: Any) -> None:
                    await context.abort(*refusal)

                return grpc.stream_stream_rpc_method_handler(refuse)
        return await continuation(handler_call_details)

    def _refusal(self, authorization: str) -> tuple[grpc.StatusCode, str] | None:
        scheme, _, token = authorization.partition(" ")
        if scheme != "Bearer":
            words = "this server asks for a token and none came; give the file that holds one (--token-file)"
            return grpc.StatusCode.UNAUTHENTICATED, words
        # The look-up compares hashes: its time tells nothing of the tokens.
        role = self._roles.get(_digest(token))
        if role is None:
            words = "this server does not know the token; compare --token-file with the server's tokens"
            return grpc.StatusCode.UNAUTHENTICATED, words
        if role == "viewer":
            words = "the token's role is viewer, which may not drive environments; use one of an actor"
            return grpc.StatusCode.PERMISSION_DENIED, words
        return None


def _parse(path: Path) -> dict[bytes, str]:
    """Roles by the hashes of their tokens. Errors name the line and never the token."""
    roles: dict[bytes, str] = {}
    for number, line in enumerate(_text(path).splitlines(), 1):
        role, token = [*line.split(None, 1), "", ""][:2]
        if not role or role.startswith("#"):
            continue
        digest = _digest(token.rstrip())
        if role not in ROLES:
            raise SecurityError(f"{path}: line {number}: `{role}` is no role; there are {', '.join(ROLES)}")
        if not TOKEN.fullmatch(token.rstrip()):
            raise SecurityError(f"{path}: line {number}: a token has at least 16 printable characters and no spaces")
        if digest in roles:
            raise SecurityError(f"{path}: line {number}: the same token as in a line before")
        roles[digest] = role
    if not roles:
        raise SecurityError(f"{path}: it holds no token; write lines `ROLE TOKEN`")
    return roles


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode()).digest()


def _pem(path: Path, kind: str) -> bytes:
    text = _text(path)
    if not any(line.startswith("-----BEGIN ") and kind in line for line in text.splitlines()):
        raise SecurityError(f"{path}: it holds no PEM block of a {kind.lower()}")
    return text.encode()


def _text(path: Path) -> str:
    try:
        return Path(path).read_text()
    except (OSError, UnicodeError) as error:
        raise SecurityError(f"cannot read {path}: {error}; `isodream secrets DIR` makes such files") from error
