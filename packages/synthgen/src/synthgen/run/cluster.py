"""The processes that render: local ones, or those of a running dask cluster.

A dask scheduler or worker runs any code that it receives. Local processes listen on loopback only, with TLS and a key
that is made for the run and passed in memory: a connection without it is refused. A cluster's certificates are options.
"""

import importlib.util
import logging
import ssl
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster, Nanny
from distributed.security import Security
from distributed.system import MEMORY_LIMIT
from posecore.errors import ConfigError, RenderError
from posecore.files import read_regular
from posecore.processes import interrupts_ignored

_TALKATIVE = ("distributed", "bokeh", "tornado", "asyncio")
SETTINGS = {
    "distributed.worker.multiprocessing-method": "spawn",  # a forked Blender is undefined
    # The dispatcher handles tasks that lose their worker: dask also blames tasks that only waited on that worker.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.scheduler.work-stealing": False,
    # A renderer's memory is not dask's: only a restart frees it, spilling or pausing does not.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.comm.timeouts.connect": "60s",
    # By default a worker that needs more than 15 s to start again, on a busy machine, is dropped for good.
    "distributed.deploy.lost-worker-timeout": "1h",
    "distributed.worker.http.routes": [],  # dask always opens a port for HTTP: nothing is served there
    "distributed.logging": dict.fromkeys(_TALKATIVE, "critical"),  # for the workers, which apply it at their start
}
LOOPBACK = "127.0.0.1"
ANSWER_S = 30.0
"""Timeout for the scheduler's answer."""
_PAGES = [f"distributed.http.{name}" for name in ("scheduler.info", "scheduler.json", "health", "statics")]
"""Pages beside the dashboard. Dask's default list has a proxy too."""
_LARGEST_PEM_BYTES = 1 << 20
_START_TRIES = 8
_MEMORY_FRACTION = 0.9  # of the machine, for all workers
_LEAST_BYTES = 3 << 29  # Blender with a large mesh needs 1.5 GiB; a lower limit would kill sound workers


@dataclass(frozen=True, kw_only=True)
class Certificates:
    """PEM files for a scheduler that was started with TLS.

    Attributes:
        ca: Certificate of the authority that signed all certificates of the cluster.
        cert: Certificate of this command.
        key: Its private key; None where it is in the same file.
    """

    ca: Path
    cert: Path
    key: Path | None = None

    def security(self) -> Security:
        """The certificates as dask takes them.

        Raises:
            ConfigError: A file cannot be read, or is no certificate or key.
        """
        key = self.key or self.cert
        for option, file in (("--tls-ca", self.ca), ("--tls-cert", self.cert), ("--tls-key", key)):
            try:
                content = read_regular(file, _LARGEST_PEM_BYTES)
            except OSError as error:
                raise ConfigError(f"{option} {file}: {error.strerror}; give a PEM file") from error
            if b"ENCRYPTED" in content:
                raise ConfigError(
                    f"{option} {file}: has a passphrase, which dask would ask for; give a key without one"
                )
        security = Security(
            tls_ca_file=str(self.ca), tls_client_cert=str(self.cert), tls_client_key=str(key),
            require_encryption=True,
        )  # fmt: skip
        try:
            security.get_connection_args("client")
        except (ssl.SSLError, ValueError) as error:
            raise ConfigError(
                f"--tls-ca {self.ca}, --tls-cert {self.cert}, --tls-key {key}: not certificates and their key in "
                f"PEM ({_first_line(error)})"
            ) from error
        return security


@contextmanager
def connect(
    workers: int, scheduler: str | None, *, certificates: Certificates | None = None, dashboard: int | None = None
) -> Iterator[Client]:
    """A client of a running cluster, or of local processes that live as long as the block.

    Args:
        workers: Local processes; without effect with a scheduler.
        scheduler: Address of a dask scheduler, or None.
        certificates: For a scheduler with TLS; None for one without, or where dask's own configuration names them.
        dashboard: Port on loopback of dask's web page of local processes; None for none.

    Raises:
        ConfigError: The certificates cannot be used, the dashboard's library is missing or its port is taken.
        RenderError: The scheduler does not answer, or no process can be started.
    """
    for name in list(logging.root.manager.loggerDict):  # they log a traceback for each broken connection
        if name.split(".")[0] in _TALKATIVE:  # some of distributed's loggers have levels of their own
            logging.getLogger(name).setLevel(logging.CRITICAL)
    with dask.config.set({**SETTINGS, **_http(dashboard)}):
        if scheduler is not None:
            with _remote(scheduler, certificates) as client:
                yield client
            return
        with interrupts_ignored():
            cluster = _local(workers, dashboard)
        with cluster, Client(cluster) as client:
            assert cluster.scheduler is not None
            if dashboard not in (None, cluster.scheduler.http_server.port):  # dask takes another one in silence
                raise ConfigError(f"--dashboard {dashboard}: this port is taken; give another one")
            yield client


def memory_limit_bytes(workers: int) -> int:
    """Memory at which a local worker is restarted."""
    return max(int(MEMORY_LIMIT * _MEMORY_FRACTION / workers), min(_LEAST_BYTES, MEMORY_LIMIT))


def revive(local: LocalCluster, suspected: set[Any]) -> set[Any]:
    """Restart workers that the cluster has dropped, or whose nanny has given up.

    Dask does not always restart a worker that dies during its start.

    Args:
        local: The cluster.
        suspected: Names of workers without a process at the last call.

    Returns:
        Names of workers without a process now, for the next call some seconds later.
    """
    nannies = {name: nanny for name, nanny in list(local.workers.items()) if isinstance(nanny, Nanny)}
    dead = {name for name, nanny in nannies.items() if not nanny.is_alive()}
    given_up = dead & suspected
    for name in given_up:
        local.workers.pop(name, None)
        local.sync(nannies[name].close, asynchronous=False)
    if set(local.worker_spec) - set(local.workers):
        with interrupts_ignored():
            local.scale(len(local.worker_spec))
    return dead - given_up


def _http(dashboard: int | None) -> dict[str, Any]:
    """Settings of the HTTP server that a scheduler always has."""
    if dashboard is None:
        return {"distributed.scheduler.http.routes": []}
    origins = [f"{host}:{dashboard}" for host in (LOOPBACK, "localhost")]  # dask's default: pages of any web site
    return {
        "distributed.scheduler.http.routes": _PAGES,
        "distributed.scheduler.dashboard.bokeh-application.allow_websocket_origin": origins,
    }


def _local(workers: int, dashboard: int | None) -> LocalCluster:
    if dashboard is not None and importlib.util.find_spec("bokeh") is None:
        raise ConfigError("--dashboard: needs the library bokeh; pip install 'synthgen[dashboard]'")
    security = Security.temporary()
    for tries_left in reversed(range(_START_TRIES)):
        try:
            warnings.filterwarnings("ignore", "Port .* is already in use", UserWarning)  # `connect` refuses it
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host=LOOPBACK,
                security=security,
                dashboard_address=f"{LOOPBACK}:{dashboard or 0}",
                scheduler_kwargs={"dashboard": dashboard is not None},
                silence_logs=logging.CRITICAL,
                memory_limit=memory_limit_bytes(workers),
            )
        except (OSError, RuntimeError) as error:  # a worker died during its start
            if not tries_left:
                raise RenderError(
                    f"--workers {workers}: the worker processes do not start ({_first_line(error)}); "
                    "start again with fewer"
                ) from error
    raise AssertionError("the last try returns or raises")


def _remote(scheduler: str, certificates: Certificates | None) -> Client:
    is_encrypted = scheduler.startswith("tls://")
    if certificates is not None and not is_encrypted:
        raise ConfigError(f"--scheduler {scheduler}: expected tls://HOST:PORT with --tls-ca and --tls-cert")
    security = Security() if certificates is None else certificates.security()
    files = security.get_tls_config_for_role("client")
    if is_encrypted and not (files["ca_file"] and files["cert"]):
        raise ConfigError(f"--scheduler {scheduler}: needs the certificates --tls-ca and --tls-cert")
    try:
        return Client(scheduler, timeout=ANSWER_S, security=security)
    except (OSError, ValueError) as error:
        refused = " with these certificates" if is_encrypted else ""
        raise RenderError(
            f"--scheduler {scheduler}: no dask scheduler answers there{refused}; start one with `dask scheduler` and "
            "workers with `dask worker ADDRESS --nthreads 1`"
        ) from error


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
