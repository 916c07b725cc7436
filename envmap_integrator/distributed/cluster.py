"""Clusters: one that is there already, or workers on this machine."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress

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
    Dask's configuration that counts. Raises ``ValueError`` if nothing answers there.
    """
    security = None
    if tls:
        ca, certificate, key = tls
        security = Security(
            require_encryption=True,
            tls_ca_file=ca,
            tls_client_cert=certificate,
            tls_client_key=key,
        )
    try:
        client = Client(address, security=security, timeout=10, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f'no scheduler answers at "{address}" ({reason}); start one with: dask scheduler'
        ) from None
    with client:
        yield client


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
