"""What travels: a JSON header and bytes in each message; who may send it; and what went wrong, in words."""

from __future__ import annotations

import hmac
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import grpc

from relmm.errors import ConfigError, FleetError, RelmmError

SERVICE = "relmm.Fleet"
CALLS = ("register", "put", "weights", "heartbeat")
VERSION = "1"  # of the protocol; others are refused
CHUNK_BYTES = 256 << 10  # how much of an episode, or of weights, one message carries
MESSAGE_BYTES = 2 << 20  # the largest message, header included
MAX_EPISODE_BYTES = 256 << 20
MAX_WEIGHTS_BYTES = 2 << 30
MANY_ROBOTS = 10_000  # most robots of one server: each needs memory and a folder
_VERSION_KEY, _TOKEN_KEY = "relmm-version", "authorization"
_LENGTH = struct.Struct("<I")
_MIN_TOKEN = 16  # characters
# What a repetition may mend; everything else is a refusal.
_PASSING = {
    grpc.StatusCode.UNAVAILABLE,
    grpc.StatusCode.DEADLINE_EXCEEDED,
    grpc.StatusCode.RESOURCE_EXHAUSTED,
    grpc.StatusCode.CANCELLED,
}
CHANNEL_OPTIONS = [
    ("grpc.max_receive_message_length", MESSAGE_BYTES),
    ("grpc.max_send_message_length", MESSAGE_BYTES),
    ("grpc.max_reconnect_backoff_ms", 5000),
]


class LinkError(FleetError):
    """The other side cannot be reached just now; a repetition may mend it."""


class RestartError(FleetError):
    """What was sent does not follow on what the server has: register again, and go on from there."""


def pack(header: dict[str, Any], body: bytes = b"") -> bytes:
    """A message: the header's length, the header as JSON, and the body."""
    words = json.dumps(header).encode()
    return _LENGTH.pack(len(words)) + words + body


def unpack(message: bytes) -> tuple[dict[str, Any], bytes]:
    """Header and body of a message.

    Raises:
        FleetError: it is none.
    """
    try:
        (length,) = _LENGTH.unpack_from(message)
        start = _LENGTH.size
        header = json.loads(message[start : start + length])
    except (struct.error, ValueError, RecursionError) as error:
        raise FleetError(f"a message cannot be read ({error}); use the same version of relmm on both sides.") from error
    if not isinstance(header, dict):
        raise FleetError("a message has no header; use the same version of relmm on both sides.")
    return header, message[start + length :]


def number(header: dict[str, Any], name: str, largest: int) -> int:
    """A whole number of a header.

    Raises:
        FleetError: it is missing, negative, or too large.
    """
    value = header.get(name)
    if type(value) is not int or not 0 <= value <= largest:
        raise FleetError(f"{name} is {value!r}, but must be a whole number of at most {largest:,}.")
    return value


def text(header: dict[str, Any], name: str) -> str:
    """A word of a header.

    Raises:
        FleetError: it is missing.
    """
    value = header.get(name)
    if not isinstance(value, str) or len(value) > 1000:
        raise FleetError(f"{name} is {str(value)[:50]!r}, but must be a short text.")
    return value


def read_token(path: Path | None) -> str:
    """The token that all robots of a fleet and their server share.

    Raises:
        ConfigError: no file, one that others may read, or a token that is easily guessed.
    """
    if path is None:
        raise ConfigError("Say which file holds the fleet's token: --fleet.token_file=FILE (docs/fleet.md makes one).")
    token = _read(path, "token_file").decode(errors="replace").strip()
    if path.stat().st_mode & 0o077:
        raise ConfigError(f"fleet.token_file {path} can be read by others on this machine: say `chmod 600 {path}`.")
    if len(token) < _MIN_TOKEN or not token.isascii() or not token.isprintable():
        raise ConfigError(
            f"fleet.token_file {path} holds a token of {len(token)} characters, but must have at least {_MIN_TOKEN} "
            "letters and digits: make one with `openssl rand -hex 32`."
        )
    return token


def server_credentials(certificate: Path | None, key: Path | None) -> grpc.ServerCredentials:
    """TLS of the server; there is no server without.

    Raises:
        ConfigError: a file is missing.
    """
    if certificate is None or key is None:
        raise ConfigError(
            "A server needs TLS: say --fleet.certificate=FILE and --fleet.key=FILE (docs/fleet.md makes both)."
        )
    return grpc.ssl_server_credentials([(_read(key, "key"), _read(certificate, "certificate"))])


def open_channel(server: str, token: str, certificate: Path | None) -> grpc.Channel:
    """A channel to the server, which is connected when it is first used.

    Args:
        server: HOST:PORT.
        token: sent with every call, and only over TLS.
        certificate: whom to trust; None for the authorities that the system trusts.

    Raises:
        ConfigError: a file is missing.
    """
    trusted = None if certificate is None else _read(certificate, "certificate")
    credentials = grpc.composite_channel_credentials(
        grpc.ssl_channel_credentials(trusted), grpc.access_token_call_credentials(token)
    )
    return grpc.secure_channel(server, credentials, CHANNEL_OPTIONS)


def _read(path: Path, option: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"fleet.{option} {path} cannot be read ({error.strerror}); check the name.") from error


def call(channel: grpc.Channel, name: str, header: dict[str, Any], body: bytes, timeout: float) -> Any:
    """Ask the server.

    Args:
        channel: of `open_channel`.
        name: one of `CALLS`.
        header: of the message.
        body: likewise.
        timeout: s.

    Returns:
        Header and body of the answer.

    Raises:
        LinkError: no answer; a repetition may get one.
        RestartError: the server has come to another point than we.
        FleetError: it refuses, with its sentence.
    """
    try:
        answer = channel.unary_unary(f"/{SERVICE}/{name}")(
            pack(header, body), timeout=timeout, metadata=[(_VERSION_KEY, VERSION)]
        )
    except grpc.RpcError as error:
        words = " ".join((error.details() or "").split())
        if error.code() in _PASSING:
            raise LinkError(words.rsplit(": ", 1)[-1] or error.code().name.lower()) from error
        if error.code() is grpc.StatusCode.ABORTED:
            raise RestartError(words) from error
        raise FleetError(words or f"the server has refused ({error.code().name.lower()}).") from error
    return unpack(answer)


Handler = Callable[[dict[str, Any], bytes], tuple[dict[str, Any], bytes]]


def service(handlers: dict[str, Handler]) -> grpc.GenericRpcHandler:
    """Makes gRPC's handlers of functions that take and give header and body; what they refuse is sent as a sentence."""

    def handler(answer: Handler) -> grpc.RpcMethodHandler:
        def handle(message: bytes, context: grpc.ServicerContext) -> bytes:
            try:
                return pack(*answer(*unpack(message)))
            except RestartError as error:
                code, words = grpc.StatusCode.ABORTED, str(error)
            except LinkError as error:
                code, words = grpc.StatusCode.RESOURCE_EXHAUSTED, str(error)
            except RelmmError as error:
                code, words = grpc.StatusCode.INVALID_ARGUMENT, str(error)
            context.abort(code, words)
            raise AssertionError  # `abort` never returns

        return grpc.unary_unary_rpc_method_handler(handle)

    return grpc.method_handlers_generic_handler(SERVICE, {name: handler(answer) for name, answer in handlers.items()})


class Guard(grpc.ServerInterceptor):
    """Lets nobody in without the token, and nobody of another version.

    Args:
        token: of the fleet.
    """

    def __init__(self, token: str) -> None:
        self._expected, self._version = f"Bearer {token}".encode(), VERSION

    def intercept_service(
        self, continuation: Callable[[Any], grpc.RpcMethodHandler], details: grpc.HandlerCallDetails
    ) -> grpc.RpcMethodHandler:
        """See gRPC: called before anything of a message is looked at."""
        sent = dict(details.invocation_metadata)
        if not hmac.compare_digest(str(sent.get(_TOKEN_KEY, "")).encode(), self._expected):
            return _refusal(
                grpc.StatusCode.UNAUTHENTICATED, "the token is not the server's: copy its --fleet.token_file here."
            )
        if sent.get(_VERSION_KEY) != self._version:
            return _refusal(
                grpc.StatusCode.FAILED_PRECONDITION,
                f"the server speaks version {self._version} of the fleet's protocol, and this is version "
                f"{str(sent.get(_VERSION_KEY))[:20]}: install the same relmm on both.",
            )
        return continuation(details)


def _refusal(code: grpc.StatusCode, words: str) -> grpc.RpcMethodHandler:
    return grpc.unary_unary_rpc_method_handler(lambda message, context: context.abort(code, words))
