"""Who can reach the processes of a render: loopback only, and nobody without the credential."""

import json
import os
import socket
import ssl
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from children import started, wait_until
from click.testing import CliRunner
from distributed import Client
from distributed.security import Security
from posecore.errors import ConfigError
from render_processes import render_command as command
from synthgen.cli import main
from synthgen.run import cluster as dask_cluster

LOOPBACK = {"127.0.0.1", "::1"}
LONG_S = 1800  # only against hanging


def listening(pid):
    """Addresses that a process and its children listen on, as `ss -ltnp` shows them."""
    family = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    return {
        (process.pid, *connection.laddr)
        for process in family
        for connection in process.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    }


@contextmanager
def rendering(tug_ply, out, small_set, *extra):
    """A real render in a process of its own, with its first shard committed; more remain than it can do meanwhile."""
    arguments = command(tug_ply, out, [*small_set, "--n", "200000", "--test-images", "0"], *extra)
    with started(arguments) as process:
        wait_until((out / "manifest.jsonl").exists, process)
        yield process


def greeting(host, port, security=None):
    """First bytes of a dask process to a new connection, which it sends to whom it lets in."""
    with socket.create_connection((host, port), LONG_S) as plain:
        if security is None:
            plain.sendall(bytes(64))
            return plain.recv(1)
        context = security.get_connection_args("client")["ssl_context"]
        context.verify_mode = ssl.CERT_NONE  # a stranger accepts any server
        with context.wrap_socket(plain) as secured:
            return secured.recv(1)


def is_refused(*arguments):
    try:
        return greeting(*arguments) == b""
    except (ConnectionError, ssl.SSLError):
        return True


@pytest.mark.slow
def test_a_render_listens_on_loopback_only_and_runs_no_strangers_code(tmp_path, tug_ply, small_set):
    with rendering(tug_ply, tmp_path / "shards", small_set, "--workers", "2") as process:
        ports = listening(process.pid)
        assert len({pid for pid, _, _ in ports}) == 3  # the command and both workers
        assert {host for _, host, _ in ports} <= LOOPBACK
        stranger, speak_http = Security.temporary(), []
        for _, host, port in ports:
            reply = http(host, port)
            if reply:
                speak_http.append(reply)
            else:
                assert is_refused(host, port, stranger)
                assert is_refused(host, port)
        assert len(speak_http) == 3  # dask opens a port for HTTP in each process, and serves nothing
        assert all(reply.startswith(b"HTTP/1.1 404 ") for reply in speak_http)
        assert process.poll() is None


def http(host, port, page="/json/identity.json"):
    """Answer to a request, for the page that lists a scheduler's workers; none from a port of dask's protocol."""
    try:
        with socket.create_connection((host, port), LONG_S) as plain:
            plain.sendall(f"GET {page} HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n".encode())
            return plain.recv(4096)
    except ConnectionError:
        return b""


@pytest.mark.slow
def test_the_credential_lets_in_and_another_one_does_not():
    with dask_cluster.connect(1, None) as client:
        address, security = client.scheduler.address, client.security
        assert address.startswith("tls://127.0.0.1:")
        host, port = "127.0.0.1", int(address.rpartition(":")[2])
        assert greeting(host, port, security)
        assert is_refused(host, port, Security.temporary())
        assert is_refused(host, port)
        with Client(address, security=security, timeout=LONG_S) as second:
            assert second.run(os.getpid)


def test_the_dashboard_is_refused_by_name_without_its_library(tmp_path, tug_ply, small_set, monkeypatch):
    monkeypatch.setitem(sys.modules, "bokeh", None)
    monkeypatch.setattr(dask_cluster.importlib.util, "find_spec", lambda name: None)
    result = CliRunner().invoke(main, command(tug_ply, tmp_path / "shards", small_set, "--dashboard")[3:])
    assert result.exit_code == 2
    assert "Error: --dashboard: needs the library bokeh; pip install 'synthgen[dashboard]'" in result.stderr


@pytest.mark.slow
def test_the_dashboard_is_on_loopback_at_its_port_and_a_taken_port_is_one_line(capfd):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        refused = pytest.raises(ConfigError, match=f"--dashboard {port}: this port is taken; give another one")
        with refused, dask_cluster.connect(1, None, dashboard=port):
            pass
    assert capfd.readouterr().err == ""
    with dask_cluster.connect(1, None, dashboard=port):
        assert {host for _, host, _ in listening(os.getpid())} <= LOOPBACK
        assert b" 200 " in http("127.0.0.1", port, "/status").partition(b"\r\n")[0]
        assert b" 404 " in http("127.0.0.1", port, "/proxy/1/127.0.0.1/status").partition(b"\r\n")[0]


def certificate(folder):
    """The certificate of the documentation: one for all, its key and itself in a file."""
    made = Security.temporary()
    (folder / "render.crt").write_text(made.tls_ca_file)
    (folder / "render.pem").write_text(made.tls_client_key + made.tls_client_cert)
    return folder / "render.crt", folder / "render.pem"


@pytest.fixture
def encrypted(tmp_path):
    """Address of a scheduler with TLS and a worker, and the certificate files."""
    ca, pem = certificate(tmp_path)
    tls = ["--tls-ca-file", str(ca), "--tls-cert", str(pem), "--tls-key", str(pem), "--no-dashboard"]
    file = tmp_path / "scheduler.json"
    start = [sys.executable, "-m", "dask"]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = [*start, "scheduler", "--protocol", "tls", "--host", "127.0.0.1", "--port", "0", *tls]
    with started([*scheduler, "--scheduler-file", file], **silent) as process:
        address = json.loads(wait_until(lambda: file.exists() and file.read_text(), process))["address"]
        with started([*start, "worker", address, "--nthreads", "1", *tls], **silent):
            yield address, ca, pem


@pytest.mark.slow
def test_a_cluster_with_certificates_renders_and_refuses_others(encrypted, tmp_path, tug_ply, small_set, monkeypatch):
    address, ca, pem = encrypted
    assert address.startswith("tls://")
    out, tls = tmp_path / "shards", ("--tls-ca", str(ca), "--tls-cert", str(pem))
    arguments = command(tug_ply, out, small_set, "--scheduler", address, *tls)
    rendered = CliRunner().invoke(main, arguments[3:])
    assert rendered.exit_code == 0, rendered.output
    assert (out / "manifest.jsonl").read_text().count("\n") == 12
    other = tmp_path / "other"
    other.mkdir()
    strange_ca, strange_pem = certificate(other)
    refused = command(
        tug_ply, tmp_path / "b", small_set, "--scheduler", address,
        "--tls-ca", str(strange_ca), "--tls-cert", str(strange_pem),
    )  # fmt: skip
    monkeypatch.setattr(dask_cluster, "ANSWER_S", 2.0)
    result = CliRunner().invoke(main, refused[3:])
    assert result.exit_code == 1
    assert f"Error: --scheduler {address}: no dask scheduler answers there with these certificates" in result.stderr


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--scheduler", "tls://a:1"], "--scheduler tls://a:1: needs the certificates --tls-ca and --tls-cert"),
        (["--tls-ca", "{crt}", "--tls-cert", "{pem}"], "--tls-ca and --tls-cert are for --scheduler"),
        (["--scheduler", "tls://a:1", "--tls-ca", "{crt}"], "--tls-ca and --tls-cert: give both"),
        (
            ["--scheduler", "tcp://a:1", "--tls-ca", "{crt}", "--tls-cert", "{pem}"],
            "--scheduler tcp://a:1: expected tls://HOST:PORT with --tls-ca and --tls-cert",
        ),
        (
            ["--scheduler", "tls://a:1", "--tls-ca", "{crt}", "--tls-cert", "{none}"],
            "{none}: No such file or directory; give a PEM file",
        ),
        (
            ["--scheduler", "tls://a:1", "--tls-ca", "{junk}", "--tls-cert", "{pem}"],
            "not certificates and their key in PEM",
        ),
        (["--scheduler", "tls://a:1", "--tls-ca", "{crt}", "--tls-cert", "/dev/zero"], "/dev/zero: is a device"),
        (["--scheduler", "tls://a:1", "--tls-ca", "{crt}", "--tls-cert", "{locked}"], "has a passphrase"),
        (["--scheduler", "tcp://a:1", "--dashboard"], "--dashboard is for local processes"),
        (["--dashboard", "70000"], "70000 is not in the range 1<=x<=65535"),
    ],
)
def test_certificates_that_do_not_fit_are_one_line(tmp_path, tug_ply, small_set, options, line):
    crt, pem = certificate(tmp_path)
    junk, locked, none = (tmp_path / name for name in ("junk", "locked", "none"))
    junk.write_text("junk")
    locked.write_text(pem.read_text().replace("PRIVATE KEY", "ENCRYPTED PRIVATE KEY"))
    names = {"crt": crt, "pem": pem, "junk": junk, "locked": locked, "none": none}
    words = [word.format(**names) for word in options]
    result = CliRunner().invoke(main, command(tug_ply, tmp_path / "shards", small_set, *words)[3:])
    assert result.exit_code == 2
    assert line.format(**names) in result.stderr
    assert sum(text.startswith("Error: ") for text in result.stderr.splitlines()) == 1
    assert not Path(tmp_path / "shards").exists()
