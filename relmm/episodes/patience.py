"""Requests of this process to the Hub come to an end, whatever the Hub does."""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import cache
from typing import Any

import httpcore
import httpx

_TIMEOUT_S = 100.0  # to wait for the Hub in one request, where huggingface_hub names no time of its own
_SLOWEST = 1000.0  # bytes a second


@cache
def limit_waiting() -> None:
    """Let this process wait for the Hub in one request for a limited time, all in all.

    huggingface_hub waits forever, or for so long before each byte, that a byte now and then keeps it waiting. Here
    every byte that comes pays for the time that it takes at 1 kB/s, so large files may take as long as they need.
    """
    from huggingface_hub import set_client_factory
    from huggingface_hub.utils._http import default_client_factory

    def factory() -> httpx.Client:
        client = default_client_factory()
        client.timeout = httpx.Timeout(_TIMEOUT_S)
        # Neither library has a public place for it that keeps the proxies of the environment.
        for transport in (client._transport, *client._mounts.values()):
            if isinstance(transport, httpx.HTTPTransport):
                pool: Any = transport._pool
                pool._network_backend = _Backend(pool._network_backend)
        return client

    set_client_factory(factory)


class _Backend(httpcore.NetworkBackend):
    """Opens connections whose patience is limited."""

    def __init__(self, backend: httpcore.NetworkBackend) -> None:
        self._backend = backend

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        return _Stream(self._backend.connect_tcp(host, port, timeout, local_address, socket_options))

    def connect_unix_socket(
        self, path: str, timeout: float | None = None, socket_options: Iterable[Any] | None = None
    ) -> httpcore.NetworkStream:
        return _Stream(self._backend.connect_unix_socket(path, timeout, socket_options))

    def sleep(self, seconds: float) -> None:
        self._backend.sleep(seconds)


class _Stream(httpcore.NetworkStream):
    """A connection: what is written begins a request, what is then read is its answer."""

    def __init__(self, stream: httpcore.NetworkStream) -> None:
        self._stream = stream
        self._waited_s = 0.0  # for the answer, less what its bytes have paid for

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        patience = _TIMEOUT_S if timeout is None else timeout
        if self._waited_s >= patience:
            raise httpcore.ReadTimeout(f"less than {_SLOWEST:.0f} bytes a second for {patience:.0f} s")
        started = time.monotonic()
        data = self._stream.read(max_bytes, patience - self._waited_s)
        self._waited_s = max(0.0, self._waited_s + time.monotonic() - started - len(data) / _SLOWEST)
        return data

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        # The system takes many bytes at once, so here a time for each is enough.
        self._waited_s = 0.0
        self._stream.write(buffer, timeout)

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self, ssl_context: Any, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        return _Stream(self._stream.start_tls(ssl_context, server_hostname, timeout))

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)
