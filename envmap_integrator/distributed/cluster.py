"""Clusters: one that is there already, or workers on this machine."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import dask
import psutil
from distributed import Client, LocalCluster, Security

from .worker import THREADS

#: Workers of our own that may die at the same call before it's given up; the rest is Dask's.
ALLOWED_FAILURES = 10


@contextmanager
def connected(address: str, tls: tuple[str, str, str] | None = None) -> Iterator[Client]:
    """A client of the scheduler at an address such as ``tcp://…:8786``.

    ``tls`` names files in PEM format: the authority's certificate, ours, and our key; without, it's
    Dask's configuration that counts. Raises ``ValueError`` if they can't be used, or if nothing
    answers there.
    """
    security = _security(address, tls)
    _say_it_ourselves()
    try:
        client = Client(address, security=security, timeout=10, set_as_default=False)
    except OSError as error:
        reason = " ".join(str(error).split())
        fix = "start one with: dask scheduler"
        if "TLS" in reason:
            fix = "its certificate and ours must be signed by the authority that both name"
        elif "Connection" in reason:
            fix = f"if it wants TLS, use its address tls://{address.partition('//')[2]}"
        raise ValueError(f'no scheduler answers at "{address}" ({reason}); {fix}') from None
    with client:
        yield client


def _say_it_ourselves() -> None:
    """Log neither what Dask finds nor that connections end with us: a line of ours tells it."""
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _security(address: str, tls: tuple[str, str, str] | None) -> Security:
    """What encrypts a connection. Found out here: Dask's client would take 20 s to fail."""
    scheme, _, place = address.partition("://")
    if scheme not in ("tcp", "tls") or not place.rpartition(":")[2].isdigit():
        raise ValueError(f'a scheduler has an address such as tcp://render-1:8786, not "{address}"')
    if tls and scheme != "tls":
        raise ValueError(f'certificates are for addresses with tls://, not "{address}"')
    security = Security()
    if tls:
        for file in tls:
            if not Path(file).is_file():
                raise ValueError(f'there is no file "{file}"; --tls takes CA, CERT and KEY')
        ca, certificate, key = tls
        security = Security(
            require_encryption=True,
            tls_ca_file=ca,
            tls_client_cert=certificate,
            tls_client_key=key,
        )
    try:
        encrypts = security.get_connection_args("client").get("ssl_context")
    except OSError as error:
        raise ValueError(
            f"TLS files {', '.join(tls or ['of the configuration of Dask'])}: {error}; give the "
            "authority's certificate, yours, and your key"
        ) from None
    if scheme == "tls" and not encrypts:
        raise ValueError(f'"{address}" takes certificates: pass --tls CA CERT KEY')
    return security


@contextmanager
def local(n_workers: int, n_threads: int) -> Iterator[Client]:
    """``n_workers`` processes on this machine, which share ``n_threads`` threads.

    They listen on the loopback interface alone, and end with the block.
    """
    threads = max(n_threads // n_workers, 1)
    settings = {
        "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
        # Else one that is being restarted at the wrong moment would be given up.
        "distributed.deploy.lost-worker-timeout": "1 day",
    }
    _say_it_ourselves()
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=n_workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
            env={THREADS: str(threads)},
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        try:
            yield client
        finally:
            _kill(cluster)


def _kill(cluster: LocalCluster) -> None:
    """End the workers at once: those that compute would be waited for."""
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        if nanny.pid is not None:
            with suppress(psutil.NoSuchProcess):
                psutil.Process(nanny.pid).kill()
